"""Computes a trajectory from GNSS solutions, an IMU and an odometer."""
