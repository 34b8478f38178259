"""Progress, device and resumption."""
