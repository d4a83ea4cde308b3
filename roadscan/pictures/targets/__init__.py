"""Control targets that are found in pictures: where they may be, candidates, and middles to a tenth of a pixel."""
