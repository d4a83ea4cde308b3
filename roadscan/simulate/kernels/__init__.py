"""The simulator's loops, compiled with Numba: arrays in, arrays out."""
