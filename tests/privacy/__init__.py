"""Privacy of published pictures."""
