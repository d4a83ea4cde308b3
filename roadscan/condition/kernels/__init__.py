"""Kernels of condition: sampling of heights, quarter cars, wires and straightedges."""
