"""Images, depth and lenses of other drivers."""

from tests.cases.case import Case

CASES: tuple[Case, ...] = ()
