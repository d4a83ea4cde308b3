"""The containers of bags: files of ROS 1, MCAP and SQLite, their chunks and their compression."""
