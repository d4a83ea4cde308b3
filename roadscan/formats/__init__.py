"""Raw logs in: one file a format, found by itself."""
