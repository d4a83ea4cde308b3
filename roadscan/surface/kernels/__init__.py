"""Kernels of surfaces: triangulation, smoothing, holes, coarse heights."""
