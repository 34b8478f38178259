"""The spheres of a robot, and which robot a job works with."""
