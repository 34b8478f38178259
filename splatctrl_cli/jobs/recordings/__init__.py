"""Recordings that jobs read, and checks that a scene was made from them."""
