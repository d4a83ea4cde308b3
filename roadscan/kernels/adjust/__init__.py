"""Loops of the adjustment: sums of normal equations, and the entries of their inverse that are wanted."""
