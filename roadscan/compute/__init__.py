"""What all features compute with, on arrays: robust scatter, runs of flags, ways along places."""
