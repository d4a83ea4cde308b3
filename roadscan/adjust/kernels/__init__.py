"""Kernels of the adjustment: normal equations and the inverse, targets, places, patches, shifts and planes."""
