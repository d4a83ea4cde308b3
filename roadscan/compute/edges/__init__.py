"""Edges of roads along drives and reference lines, for assets and for condition."""
