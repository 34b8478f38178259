"""Robot models: kinematics, collision spheres, Jacobians."""
