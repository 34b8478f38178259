"""Opens any recorded input, and says what a file is."""
