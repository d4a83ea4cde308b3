"""What shows on a lane's surface: its texture by squares, patches that have lost stones, and the lines beside it."""
