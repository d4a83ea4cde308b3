"""Control points as passes saw them, what is wrong with them, and whether they are right as a whole."""
