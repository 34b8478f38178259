"""Distances at given points."""
