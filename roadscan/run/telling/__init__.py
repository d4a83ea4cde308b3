"""Tells what a run does: events, the one place that tells them, and those who listen."""
