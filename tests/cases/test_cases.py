"""Each input, made by our own writers and, where it lies beside the real recordings, as others made it."""

from pathlib import Path

import pytest

from tests.cases import camera_cases, container_cases, folder_cases, robot_cases, splat_cases, state_cases
from tests.cases.case import Case, run

GROUPS = (camera_cases, container_cases, folder_cases, robot_cases, splat_cases, state_cases)
CASES = {case.name: case for group in GROUPS for case in group.CASES}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_an_input_of_our_own_making_is_read_as_wanted(case: Case, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    case.make(tmp_path / "in")
    case.examine(tmp_path / "in", tmp_path / "out", run)


@pytest.mark.parametrize("case", [c for c in CASES.values() if c.has_shared], ids=lambda case: case.name)
def test_an_input_of_others_is_read_as_wanted(case: Case, real_data: Path, tmp_path: Path) -> None:
    folder = real_data.parent / "cases" / case.name
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    case.examine(folder, tmp_path, run)
