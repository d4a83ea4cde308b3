"""The adjustment of a survey: evidence from raw readings, its solution, and figures of accuracy."""
