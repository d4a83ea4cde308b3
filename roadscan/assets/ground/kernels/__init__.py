"""Loops over bare earth."""
