"""Judgements of segments: boosted trees that were fitted to labelled streets, a file a question."""
