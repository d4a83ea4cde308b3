"""Kernels for the residuals of a calibration and for matching surfaces."""
