"""The folder that a run leaves, read again."""
