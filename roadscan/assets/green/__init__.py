"""Planted ground in pictures: cells of the ground, their colours, and the edges of what is green."""
