"""Loops over the rows of logs."""
