"""Indices of longitudinal profiles from any source: roughness, texture, spectra, straightedges."""
