"""Clocks of sensors from motion that they share with others."""
