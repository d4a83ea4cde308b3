"""Strapdown mechanisation, Kalman filter and smoother of an inertial navigation system."""
