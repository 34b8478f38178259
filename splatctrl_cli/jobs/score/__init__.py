"""Scores on recorded views."""
