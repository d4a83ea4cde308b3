"""Pictures with their poses as files of other programs."""
