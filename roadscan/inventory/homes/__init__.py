"""Homes in which people see and edit the inventory: a GeoPackage, or a PostGIS database."""
