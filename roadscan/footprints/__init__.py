"""Footprints: which raw data touch which tile."""
