"""Faults drawn into files of stores: each is harmless, named by the next command that rests on it, or refused."""
