"""Kinds of layers of the site, a file a kind."""
