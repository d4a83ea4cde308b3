"""The simulator's kernels, compiled with Numba: arrays in, arrays out."""
