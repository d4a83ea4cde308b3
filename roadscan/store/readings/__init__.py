"""Reads ingested readings from the store into reused arrays."""
