"""Loops of the finders of assets."""
