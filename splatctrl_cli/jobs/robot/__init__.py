"""Robots and their spheres."""
