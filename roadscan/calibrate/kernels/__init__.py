"""Residuals of a calibration, and the surfaces that it compares."""
