"""Loops of the adjustment: meetings of tracks, patches and their shifts, normal equations, parts of their inverse."""
