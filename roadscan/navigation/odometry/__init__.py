"""Poses of a rig from its lidar's sweeps alone, in a local frame."""
