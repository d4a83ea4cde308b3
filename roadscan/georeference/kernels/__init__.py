"""Kernels that interpolate poses and georeference readings."""
