"""Scores of splats on recorded views."""
