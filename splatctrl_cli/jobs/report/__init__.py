"""Reports on runs and batches, with 3-D scenes."""
