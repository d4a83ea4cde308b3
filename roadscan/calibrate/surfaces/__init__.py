"""Surfaces that were seen more than once: loops, back-through and right-angle loops, sensor to sensor."""
