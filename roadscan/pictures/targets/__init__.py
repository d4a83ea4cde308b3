"""Control targets that are found in pictures: where they may be, candidates there, and their middles to a tenth pixel."""
