"""The formats of a baked distance grid, one a file."""
