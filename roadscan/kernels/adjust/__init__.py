"""Loops of the adjustment: where tracks meet, patches of the road and how they lie to one another, its equations."""
