"""Formats of points and surfaces that other programs georeferenced."""
