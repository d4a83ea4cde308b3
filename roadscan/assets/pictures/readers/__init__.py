"""Readers of the pictures of a kind of assets, one file a kind."""
