"""Assets: what stands on, beside and over the road, found in returns of lidars and scanners, a kind a file."""
