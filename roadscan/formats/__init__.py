"""Readers of raw logs: one file per format, found automatically."""
