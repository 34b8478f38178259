"""Every key of the configuration with values that none should take; the commands themselves run in the whole fuzz."""

from pathlib import Path

import pytest

from splatctrl_cli.config import load_config
from splatctrl_cli.errors import UsageError
from tests.cli import here
from tools.settings_fuzz import Case, cases, fault_of, section_of

ABSENT = {
    "scene": ("reconstruct", "absent.mcap"),
    "occupancy": ("reconstruct", "absent.mcap"),
    "human": ("reconstruct", "absent.mcap"),
    "field": ("sdf-bake", "absent"),
    "control": ("replay", "absent.mcap", "--scene", "absent", "--urdf", "absent", "--mode", "closed-loop"),
    "planner": ("replay", "absent.mcap", "--scene", "absent", "--urdf", "absent", "--mode", "closed-loop"),
    "verdict": ("replay", "absent.mcap", "--scene", "absent", "--urdf", "absent"),
}


@pytest.mark.parametrize("section", ABSENT)
def test_every_value_out_of_range_is_refused_in_words_and_every_other_one_is_taken(section: str) -> None:
    asked = [case for case in cases() if case.section == section]
    assert len({case.key for case in asked}) == len(section_of(section).declared)
    for case in asked:
        name = f"{section}.{case.key}"
        try:
            load_config(None, [f"{name}={case.text}"])
        except UsageError as refused:
            said = str(refused)
            assert not case.is_in_range or "at least" in said or "at most" in said or "above" in said, case
            assert fault_of(case, 2, said, []) == "", said
        else:
            assert case.is_in_range, case


@pytest.mark.parametrize(("section", "words"), ABSENT.items())
def test_a_command_refuses_its_settings_before_it_reads_anything(
    tmp_path: Path, section: str, words: tuple[str, ...]
) -> None:
    for case in [case for case in cases() if case.section == section and case.text in {"nan", "bogus", "-1e308"}][:6]:
        done = here.splatctrl(*words, "-o", tmp_path / "out", "--set", f"{section}.{case.key}={case.text}")
        left = [path.name for path in tmp_path.iterdir()]
        assert (fault_of(case, done.returncode, done.stderr, left), done.returncode) == ("", 2)
        assert (done.stderr.count("\n"), done.stdout) == (1, "")


@pytest.mark.parametrize(
    ("code", "said", "left", "fault"),
    [
        (None, "", [], "hang"),
        (-11, "", [], "crash by signal 11"),
        (70, "", [], "exit 70"),
        (0, "", [], "taken out of its range"),
        (2, "no", [], "refused in other words"),
        (2, "control.margin: expected 0 to 1 m, got nan", ["out.partial"], "left behind: out.partial"),
        (2, "control.margin: expected 0 to 1 m, got nan", [], ""),
    ],
)
def test_a_fault_is_found(code: int | None, said: str, left: list[str], fault: str) -> None:
    assert fault_of(Case(section="control", key="margin", text="nan"), code, said, left) == fault
