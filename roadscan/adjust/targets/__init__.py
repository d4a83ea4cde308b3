"""Painted control targets in the intensity of one pass, and the height of any control point."""
