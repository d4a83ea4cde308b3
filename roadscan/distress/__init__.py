"""Cracks and potholes of a reconstructed surface."""
