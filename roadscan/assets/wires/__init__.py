"""Overhead wires: thin level things in the air, and the spans that they make."""
