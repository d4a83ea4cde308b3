"""Readings and passes as files of other programs."""
