"""Formats of GNSS solutions, IMU and wheel encoders."""
