"""Measuring in pictures: the place of each picture and what it shows of the ground, and places of pixels on the map."""
