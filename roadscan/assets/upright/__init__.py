"""Upright things beside the road and over it: shafts, plates, upright planes, and their shared figures."""
