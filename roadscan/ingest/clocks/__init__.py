"""Estimates the clocks of logs from pairs of stamps: line fits and corrections."""
