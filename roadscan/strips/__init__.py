"""Strips of road as each sensor of each run saw them: sensors that see no road, or another road than the others."""
