"""Kernels that count readings into cells, compute the cells' statistics, and reduce cells."""
