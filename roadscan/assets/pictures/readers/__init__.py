"""Readers of the pictures of kinds of assets."""
