"""Bare earth: which returns lie on it, its raster, its cross-sections."""
