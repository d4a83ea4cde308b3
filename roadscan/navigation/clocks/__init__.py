"""Estimates clocks of sensors from motion that several sensors measure."""
