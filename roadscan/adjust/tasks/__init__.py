"""The adjustment of a survey: evidence from raw readings, its solution, and what it says of accuracy."""
