"""Tests of jobs/sweeps."""
