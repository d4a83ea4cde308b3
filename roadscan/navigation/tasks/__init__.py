"""Tasks that compute trajectories and clocks from logs, and their records and pictures."""
