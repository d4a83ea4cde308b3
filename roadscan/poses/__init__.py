"""Poses at any epoch: trajectories, corrections to them, and checks of the poses of a log against themselves."""
