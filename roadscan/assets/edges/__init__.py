"""Edges along roads: steps and bends of the cross-section, traced as paths, and the areas that they bound."""
