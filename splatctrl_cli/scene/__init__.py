"""III-B and III-C: splats, rasteriser, losses, occupancy, add and relocate, robot labels."""
