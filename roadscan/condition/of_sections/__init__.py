"""What indices take of a section of a lane: whole cross-sections, and wheel paths with a lead."""
