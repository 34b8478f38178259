"""Splat files, point clouds and exports of other tools."""

from tests.cases.case import Case

CASES: tuple[Case, ...] = ()
