"""Instructions on whole vector registers that Numba has no word for, each with a plain twin."""
