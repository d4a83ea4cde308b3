"""Ties: what two passes say of one another at a place."""
