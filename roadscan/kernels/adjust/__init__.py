"""Loops of the adjustment."""
