"""Poses, and readings placed on the map with them."""
