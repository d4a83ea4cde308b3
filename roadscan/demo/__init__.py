"""The demo: a small survey is simulated, run, and held against its truth."""
