"""Output folders of runs, read again."""
