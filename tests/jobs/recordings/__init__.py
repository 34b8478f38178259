"""Tests of jobs/recordings."""
