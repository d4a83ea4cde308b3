"""Kernels over returns of lidars: ground, vehicles, classes."""
