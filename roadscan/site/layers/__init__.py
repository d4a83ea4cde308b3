"""Kinds of layers of the site, one per file."""
