"""Covers and drains: spots in the road that are brighter or darker than it."""
