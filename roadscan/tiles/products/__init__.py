"""Files out: one file a product, found by itself."""
