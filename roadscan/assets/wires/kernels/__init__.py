"""Kernels of lines through cubes of returns."""
