"""Poses at any epoch: trajectories, corrections of them, and what poses say of themselves."""
