"""Readings counted into cells, the cells' statistics, and what is made of cells."""
