"""Ties: measured differences between two passes at a place."""
