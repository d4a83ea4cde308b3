"""Loops of the adjustment: normal equations and the inverse, targets, places and cells of patches."""
