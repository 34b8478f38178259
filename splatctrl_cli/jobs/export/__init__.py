"""Splats and judged runs for other programs."""
