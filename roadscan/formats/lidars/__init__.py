"""Formats of spinning lidars."""
