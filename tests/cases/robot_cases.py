"""Robots of other tools: URDF, meshes, sphere files."""

from tests.cases.case import Case

CASES: tuple[Case, ...] = ()
