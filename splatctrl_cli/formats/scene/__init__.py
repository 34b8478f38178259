"""The folder of a reconstruction: splats, voxels and snapshots."""
