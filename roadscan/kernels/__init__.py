"""The loops: Numba on NumPy arrays, nothing else."""
