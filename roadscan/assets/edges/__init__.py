"""Edges along roads: steps and bends across them, sought along them as paths, and the areas that they bound."""
