"""File formats of splats, grids, scenes, arrays, images and points."""
