"""Strips of road as each sensor of each run saw them: finds sensors that see no road, or contradict the others."""
