"""Poses at any epoch: corrections and mountings are applied here and nowhere else."""
