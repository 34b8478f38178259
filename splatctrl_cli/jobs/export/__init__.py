"""Exports for viewers."""
