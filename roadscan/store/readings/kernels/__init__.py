"""Loops over stored readings."""
