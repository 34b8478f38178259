"""Progress, device and resumption of a job."""
