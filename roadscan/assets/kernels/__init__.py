"""Kernels over returns of lidars: ground, edges, paint, vehicles, upright things, classes."""
