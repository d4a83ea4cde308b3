"""Calibration: one estimator finds mountings from several kinds of observations."""
