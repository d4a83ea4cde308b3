"""Footprints: which raw block touches which tile."""
