"""Loops over boosted trees."""
