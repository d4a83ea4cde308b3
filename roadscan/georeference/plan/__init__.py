"""The plan of a survey: sources, mountings, road segmentation, centre lines, corrections."""
