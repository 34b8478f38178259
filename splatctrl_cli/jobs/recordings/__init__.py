"""Recordings of jobs, and their match with scenes."""
