"""Measuring in pictures."""
