"""Formats of pictures and videos."""
