"""Recordings of which the truth is known."""
