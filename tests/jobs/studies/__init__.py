"""Tests of jobs/studies."""
