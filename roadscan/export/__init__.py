"""Exports readings and passes as files of other programs."""
