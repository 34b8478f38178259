"""Tests of jobs/compare."""
