"""Edges of the road's surface on both sides of its lanes."""
