"""Runs of the hunt and the campaigns look at no picture."""

from tests.quick import parsed_once, unpainted

__all__ = ["parsed_once", "unpainted"]
