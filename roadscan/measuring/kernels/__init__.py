"""Loops of measuring in pictures."""
