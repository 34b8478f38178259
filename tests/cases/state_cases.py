"""Joint states of other drivers."""

from tests.cases.case import Case

CASES: tuple[Case, ...] = ()
