"""Everything that touches a file format: logs, captures, splat files, grids, run folders."""
