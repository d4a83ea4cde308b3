"""Where passes meet, what ties them together and to control points, and the corrections of the poses that follow."""
