"""Kernels over bytes: delta packing, byte planes, DEFLATE, blocks of rasters."""
