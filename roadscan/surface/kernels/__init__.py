"""Surfaces: triangulation, smoothing, holes, coarse heights, colours."""
