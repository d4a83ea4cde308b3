"""Georeferencing: readings and a trajectory become points on the map, and filters select points."""
