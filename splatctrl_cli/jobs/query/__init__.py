"""Queries of fields and scenes."""
