"""Tests of jobs/query."""
