"""Tasks that calibrate mountings of sensors and interior orientations of cameras."""
