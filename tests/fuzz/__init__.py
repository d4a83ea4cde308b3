"""Damaged files of every format: see __main__.py."""
