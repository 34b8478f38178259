"""Small inputs of other people's tools, each with what is wanted of it."""
