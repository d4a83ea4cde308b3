"""Simulated sensors: each with its errors, its clock and the raw log that it writes."""
