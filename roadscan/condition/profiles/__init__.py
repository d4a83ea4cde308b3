"""Indices of longitudinal profiles, wherever these come from: roughness, texture, spectra, straightedges."""
