"""The declared inputs of a separation: what is read, and what is refused by name."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.control.separation import Deceleration, DeclaredSeparation, StopTable, read_separation
from splatctrl_cli.errors import InputError, UsageError
from tests.refused import expect_refusal

BRAKING = "[robot]\ndeceleration = 2\n[distance]\nintrusion = 0.1\n"
STOP = """
[[stop]]
axis = "{}"
extension = {}
payload = {}
speed = [0.33, 0.66, 1]
time = [0.1, 0.2, 0.3]
distance = [0.01, 0.04, 0.09]
"""
HEAD = "[robot]\nreach = 0.8\npayload = 0.5\n[distance]\nintrusion = 0\n"
TABLE = HEAD + "".join(STOP.format(a, e, p) for a in "ab" for e in (0.5, 1.0) for p in (0.66, 1.0))


def declared(tmp_path: Path, text: str) -> DeclaredSeparation:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return read_separation(path, ["a", "b"])


def test_a_declared_deceleration_or_stop_table_is_how_the_arm_stops(tmp_path: Path) -> None:
    assert declared(tmp_path, BRAKING).stopping("ab") == Deceleration(deceleration=2.0)
    table = declared(tmp_path, TABLE).stopping("ab")
    assert isinstance(table, StopTable)
    assert [[(r.axis, r.extension, r.payload) for r in rows] for rows in table.rows] == [
        [(axis, 0.5, 0.66), (axis, 1.0, 0.66)] for axis in "ab"
    ]
    assert table.rows[0][0].at(np.array([0.0, 0.33, 0.495]))[1].tolist() == pytest.approx([0.0, 0.01, 0.025])


WRONG = {
    "unknown key label; known here: who": BRAKING + "[person]\nlabel = 1\n",
    "unknown key robots; did you mean robot?": "[robots]\nreach = 1\n",
    "who: expected anything, labelled or newcomer, got 'someone'": BRAKING + "[person]\nwho = 'someone'\n",
    "person.empty_at: expected with who = 'newcomer', missing; give the time": BRAKING
    + "[person]\nwho = 'newcomer'\n",
    "reaction_time: expected 0 to 60 s, got -0.1": BRAKING.replace("[robot]", "[robot]\nreaction_time = -0.1"),
    "speed: expected 0 to 20 m/s, got True": BRAKING + "[person]\nspeed = true\n",
    "distance.intrusion: missing; declare C": "[robot]\ndeceleration = 2\n",
    "or robot.deceleration, got neither": "[distance]\nintrusion = 0\n",
    "or robot.deceleration, got both": BRAKING + STOP.format("a", 1, 1),
    "stop 1: time: missing": TABLE.replace("time = [0.1, 0.2, 0.3]\n", "", 1),
    "stop 1: speed: expected shares that rise to 1, got [0.33, 0.66, 0.9]": TABLE.replace(
        "0.66, 1]", "0.66, 0.9]", 1
    ),
    "stop 1: time: expected 0 to 1000, got -0.1": TABLE.replace("[0.1,", "[-0.1,", 1),
    "stop 1: distance: expected values that rise with the speed": TABLE.replace("0.04, 0.09", "0.04, 0.03", 1),
    "missing axis, extension, payload: b, 0.5, 0.66": HEAD
    + "".join(STOP.format("a", e, p) for e in (0.5, 1.0) for p in (0.66, 1.0)),
    "missing axis, extension, payload: b, 1.0, 1.0; declare every axis": TABLE.removesuffix(
        STOP.format("b", 1.0, 1.0)
    ),
    "an axis, extension and payload is given twice": TABLE + STOP.format("b", 1.0, 1.0),
    "unknown axis c; the robot has a, b": TABLE + STOP.format("c", 1.0, 1.0),
    "expected a payload of at least 1, got 0.66": TABLE.replace("payload = 0.5", "payload = 1").replace(
        "payload = 1.0", "payload = 0.1"
    ),
    "robot.reach: missing, for stops by extension": TABLE.replace("reach = 0.8\n", ""),
    "not valid TOML": "[person\n",
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_file_is_refused_by_the_key_and_a_remedy(words: str, tmp_path: Path) -> None:
    assert expect_refusal(words, declared, tmp_path, WRONG[words], error=UsageError).startswith(str(tmp_path))


def test_a_missing_file_is_missing_input(tmp_path: Path) -> None:
    expect_refusal(
        "cannot be read", read_separation, tmp_path / "cell.toml", ["a"], error=InputError, has_remedy=True
    )
