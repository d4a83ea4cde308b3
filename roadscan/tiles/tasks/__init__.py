"""Tasks of tiles: keys, plans, the work on workers, and files."""
