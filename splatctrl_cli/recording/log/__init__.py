"""Messages of a log to frames and joint states, in time order."""
