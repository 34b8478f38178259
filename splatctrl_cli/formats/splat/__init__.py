"""The splat file formats."""
