"""Loops over points and pixels that Numba compiles."""
