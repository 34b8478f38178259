"""File formats: splats, grids, scene folders, and the arrays, images and point tables in them."""
