"""Readings + trajectory → points, and the filters of points."""
