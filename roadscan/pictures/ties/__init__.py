"""Tie points: what several pictures show, found and matched by the poses' own geometry."""
