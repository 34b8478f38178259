"""Tests of jobs/robot."""
