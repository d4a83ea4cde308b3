"""Who has a store, and what that process knows of it."""
