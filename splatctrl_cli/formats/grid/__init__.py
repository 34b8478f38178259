"""The files that hold a baked distance grid, one format a file."""
