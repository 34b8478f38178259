"""Sweeps: the distance of a run from another verdict."""
