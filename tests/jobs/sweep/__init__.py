"""Tests of jobs/sweep."""
