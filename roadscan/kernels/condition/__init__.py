"""Kernels of condition: vehicles that roll over a profile, straightedges on it."""
