"""How files are written and read whatever they hold: whole or not at all, locked, with digests."""
