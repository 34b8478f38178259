"""The messages of damaged or whole logs: MCAP, ROS 1 bag, sqlite3."""
