"""Straight edges in joint space, proved free: the sampling-based planner compared in IV."""
