"""Colours of pictures for points and for the road: coloured clouds, and the orthophoto."""
