"""Evidence from surfaces seen more than once: in several drives, or by several sensors."""
