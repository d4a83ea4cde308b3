"""Kernels that interpolate poses."""
