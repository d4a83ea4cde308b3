"""Indices of condition, a file each."""
