"""Programs that look for faults in the whole tool; they are not installed."""
