"""Kernels of spots on the ground."""
