"""Two runs, or two batches, and what got worse."""
