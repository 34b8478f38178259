"""Programs that look for faults in the whole tool. Not part of what is installed."""
