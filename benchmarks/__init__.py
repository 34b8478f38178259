"""What the tool costs: `python -m benchmarks` (see docs/benchmarks.md). Not tests: nothing here fails a build."""
