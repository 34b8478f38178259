"""The messages of a log file, whatever the container (MCAP, ROS 1 bag, sqlite3) and whatever is damaged."""
