"""Assets: objects on, beside and over the road, found in returns of lidars and scanners; `kinds` lists them."""
