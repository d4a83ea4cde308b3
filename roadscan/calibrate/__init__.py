"""Mountings from evidence: one estimator, several kinds of observations."""
