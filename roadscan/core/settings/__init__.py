"""Settings: one file for each section of the survey file."""
