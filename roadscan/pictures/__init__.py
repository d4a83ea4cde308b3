"""Pictures of cameras: where they were taken, what they show, and what is measured in them."""
