"""Loops over the packets of lidars."""
