"""Features of a lane's surface: texture by squares, ravelled patches, and painted lines beside it."""
