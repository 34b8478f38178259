"""How many threads the kernels are given."""

import os

import pytest

from splatctrl_cli.kernels import num_threads


@pytest.mark.parametrize(
    ("processors", "requested", "given"),
    [(2, 0, 2), (2, 1, 1), (2, 16, 16), (2, 9999, 16), (64, 0, 64), (64, 9999, 64)],
)
def test_threads_are_at_most_16_or_one_per_processor(
    monkeypatch: pytest.MonkeyPatch, processors: int, requested: int, given: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(processors)))
    assert num_threads(requested) == given
