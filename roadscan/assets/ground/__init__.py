"""Bare earth: the returns on it, its raster, its cross-sections."""
