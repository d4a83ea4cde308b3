"""Loops over the bytes of point clouds."""
