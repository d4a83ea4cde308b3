"""Products over many tiles."""
