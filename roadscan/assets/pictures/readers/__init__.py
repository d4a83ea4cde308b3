"""Readers: what is looked for in the pictures of a kind of assets, one file a kind."""
