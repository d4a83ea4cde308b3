"""Kernels with vector instructions that Numba does not generate, each with an equivalent in NumPy."""
