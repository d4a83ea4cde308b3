"""Cracks and potholes: pieces a tile, and tables of what they join to."""
