"""Maps made of recordings."""
