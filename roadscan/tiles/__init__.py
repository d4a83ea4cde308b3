"""Tiles of 10 m: their cells, the blocks and tasks that compute them, and their products."""
