"""Recorded data with known truth."""
