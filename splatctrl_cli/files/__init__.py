"""Files on disk: atomic outputs, spilled rows, summaries."""
