"""The demo: a small survey is simulated, run, and compared with its truth."""
