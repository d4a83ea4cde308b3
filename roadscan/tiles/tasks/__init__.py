"""Footprints, keys and tasks of tiles; what workers do with them; files of tiles."""
