"""Folders of images with poses, as other tools write them."""

from tests.cases.case import Case

CASES: tuple[Case, ...] = ()
