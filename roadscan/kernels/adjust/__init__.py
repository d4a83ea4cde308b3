"""Loops of the adjustment: normal equations and the inverse, targets, cells of patches."""
