"""Settings: a file a section of the survey file."""
