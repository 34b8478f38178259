"""Our own recordings on disk."""
