"""Loops over pictures and their pixels that Numba compiles."""
