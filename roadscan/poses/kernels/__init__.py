"""Loops of navigation: poses at any epoch."""
