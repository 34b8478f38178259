"""Any recorded input as frames and joint states."""
