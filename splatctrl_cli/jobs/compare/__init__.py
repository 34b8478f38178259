"""Comparisons of runs and batches."""
