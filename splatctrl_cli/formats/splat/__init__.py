"""The files that hold splats, one format a file."""
