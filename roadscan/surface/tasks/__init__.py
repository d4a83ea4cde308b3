"""Keys and tasks of reconstructed surfaces, regions of interest, pictures and their colours."""
