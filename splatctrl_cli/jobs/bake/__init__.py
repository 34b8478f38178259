"""Bakes of distance grids."""
