"""Prepares sections of a lane for indices: whole cross-sections, and wheel paths with a lead."""
