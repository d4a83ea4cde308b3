"""Clocks of logs from pairs of stamps: lines through them, and corrections."""
