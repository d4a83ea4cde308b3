"""Ingested readings out of the store, into arrays that are used again."""
