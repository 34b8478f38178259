"""The hunt for false greens: random hostile recordings with known truth, judged by the whole tool."""
