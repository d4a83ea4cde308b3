"""Formats of trajectories: poses, their accuracy, and the writer of poses from arrays."""
