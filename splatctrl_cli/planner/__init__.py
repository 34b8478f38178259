"""Paths of straight edges in joint space, proved free: the sampling-based planner that IV compares with."""
