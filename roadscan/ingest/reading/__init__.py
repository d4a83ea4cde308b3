"""Shared parts of the readers of formats: records, stamps, columns, tables in text, poses, GNSS solutions."""
