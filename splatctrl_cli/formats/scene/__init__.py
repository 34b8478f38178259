"""A reconstruction's folder: splats, voxels and snapshots."""
