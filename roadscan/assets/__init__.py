"""Assets: objects on, beside and over the road, found in returns of lidars and scanners; each kind is one file."""
