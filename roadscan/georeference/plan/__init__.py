"""What places the readings of a survey: sources, mountings, road, centre lines, drives."""
