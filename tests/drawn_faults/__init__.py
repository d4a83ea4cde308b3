"""Faults drawn at random into the logs of the demo: each is named by the run, or changes no figure beyond its σ."""
