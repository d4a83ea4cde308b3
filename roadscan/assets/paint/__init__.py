"""Paint on the road: where the ground is brighter than its surroundings, and what shape that has."""
