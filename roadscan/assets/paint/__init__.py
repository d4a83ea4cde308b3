"""Paint on the road: ground brighter than its surroundings, and the shape of it."""
