"""Assets: objects on, beside and over the road, found in returns of lidars and scanners; `kinds` holds what is a kind."""
