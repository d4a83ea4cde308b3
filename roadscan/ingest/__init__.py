"""Reads raw logs into tables: fingerprints, keys and rows of logs, and checks of their times and poses."""
