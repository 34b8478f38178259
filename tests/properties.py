"""How properties are tested: a few examples, the same at every run."""

from collections.abc import Callable
from typing import TypeVar

from hypothesis import HealthCheck, settings

Test = TypeVar("Test", bound=Callable[..., None])


def few(examples: int) -> Callable[[Test], Test]:
    """Settings for so many examples: derandomised, without a deadline or a data base of failures."""
    return settings(
        max_examples=examples, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
