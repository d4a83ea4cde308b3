"""Commands are killed at drawn moments: a reader finds nothing half done, and in the end the bytes are the same."""
