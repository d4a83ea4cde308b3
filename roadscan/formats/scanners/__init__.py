"""Formats of laser profilers and line scanners."""
