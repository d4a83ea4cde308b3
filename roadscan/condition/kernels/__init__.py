"""Kernels of condition: heights in the road's own frame, vehicles that roll over a profile, wires and straightedges."""
