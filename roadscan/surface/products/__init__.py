"""Files of the reconstructed surface, by tile or for the whole survey."""
