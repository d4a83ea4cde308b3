"""Coarse and detailed reconstruction of the road surface."""
