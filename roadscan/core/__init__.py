"""Value types shared by every layer: frames, GPS time, heights, ids, rig, survey, errors."""
