"""Trajectories and clocks that are computed from logs, their records and pictures."""
