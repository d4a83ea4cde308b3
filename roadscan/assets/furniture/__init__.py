"""Street furniture: what stands compactly on the ground, and its features."""
