"""Files of the reconstructed surface, a tile or the whole survey."""
