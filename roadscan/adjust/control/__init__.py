"""Control points as passes saw them, faults of single points, and tests of the control as a whole."""
