"""Control points and lines of roads."""
