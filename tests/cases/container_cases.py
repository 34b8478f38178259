"""Containers of other recorders."""

from tests.cases.case import Case

CASES: tuple[Case, ...] = ()
