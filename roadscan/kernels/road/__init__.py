"""Which readings hit the road, and places along it."""
