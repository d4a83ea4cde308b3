"""Products of tiles: one module for each product, found by itself."""
