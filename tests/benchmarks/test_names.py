"""The benchmarks that the command names are there."""

import importlib

import pytest

from benchmarks.__main__ import NAMED, NAMES


@pytest.mark.parametrize("name", NAMES + NAMED)
def test_every_named_benchmark_has_a_module_that_runs(name: str) -> None:
    assert callable(importlib.import_module(f"benchmarks.{name}").run)
