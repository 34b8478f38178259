"""Reconstructions of recordings."""
