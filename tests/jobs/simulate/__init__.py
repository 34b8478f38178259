"""Tests of jobs/simulate."""
