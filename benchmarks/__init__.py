"""Costs of the tool: `python -m benchmarks` (see docs/benchmarks.md). No benchmark fails a build."""
