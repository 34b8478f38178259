"""Our own recordings on disk: written, read, packed, resumed."""
