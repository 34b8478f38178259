"""Scores, distance accuracy, pictures."""
