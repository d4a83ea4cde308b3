"""Loops over upright things."""
