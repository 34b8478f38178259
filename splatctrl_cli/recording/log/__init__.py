"""From the messages of a log to frames and joint states: decoded, paired, placed, in time order."""
