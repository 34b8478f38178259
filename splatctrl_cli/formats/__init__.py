"""Files of one format each: splats, grids, the folder of a reconstruction, and what they are made of."""
