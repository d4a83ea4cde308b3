"""Mountings of sensors and interior orientation of cameras from evidence."""
