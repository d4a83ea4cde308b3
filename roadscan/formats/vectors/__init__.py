"""Formats of control points and lines of roads."""
