"""Queries of fields."""
