"""The splat file formats, one a file."""
