"""Tasks of the stage `colours`."""
