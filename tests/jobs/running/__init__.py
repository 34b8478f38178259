"""Tests of jobs/running."""
