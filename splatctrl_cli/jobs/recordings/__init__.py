"""Which recording a job reads, and whether a scene was made from it."""
