"""Pictures of results, for whoever judges them: no product of tiles, one file a result."""
