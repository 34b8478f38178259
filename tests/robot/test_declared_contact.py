"""Declared contact: the file, who uses an entry, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.robot.declared_contact import Declarations, read_declarations
from tests.refused import expect_refusal

GOOD = """
[[carried]]
link = "hand"
box = [-0.1, -0.1, 0.1, 0.1, 0.1, 0.3]
start = 1
end = 2.5

[[expected_contact]]
link = "hand"
box = [0.4, -0.1, 0.0, 0.6, 0.1, 0.2]
start = 3.0
end = 4.0
reason = "the peg goes into its hole"
"""


def declared(tmp_path: Path, text: str = GOOD) -> Declarations:
    path = tmp_path / "contact.toml"
    path.write_text(text)
    return read_declarations(path, links=["arm", "hand"])


def test_a_carried_box_holds_points_of_its_link_while_it_is_carried(tmp_path: Path) -> None:
    entries = declared(tmp_path)
    points = np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 0.4]])
    for link, time, expected in (("hand", 2.0, [True, False]), ("arm", 2.0, [False] * 2), ("hand", 2.6, [False] * 2)):
        assert entries.is_carried(link, points, time).tolist() == expected
    assert [[link for link, _ in entries.carried_at(time)] for time in (1.0, 0.9)] == [["hand"], []]


def test_a_contact_is_expected_at_its_link_place_and_time_alone(tmp_path: Path) -> None:
    entries = declared(tmp_path)
    place = np.array([0.5, 0.0, 0.1])
    assert entries.find_expected("hand", place, 3.5).reason == "the peg goes into its hole"
    for link, at, time in (("arm", place, 3.5), ("hand", place + 0.2, 3.5), ("hand", place, 4.5)):
        assert entries.find_expected(link, at, time) is None


def test_what_nothing_used_is_known(tmp_path: Path) -> None:
    entries = declared(tmp_path)
    for contact, carried, left in (
        ([0.9, 0.0, 0.1], [0.0, 0.0, 0.9], [("carried", 0), ("expected_contact", 0)]),
        ([0.5, 0.0, 0.1], [0.0, 0.0, 0.9], [("carried", 0)]),
        ([0.9, 0.0, 0.1], [0.0, 0.0, 0.2], []),
    ):
        entries.find_expected("hand", np.array(contact), 3.5)
        entries.is_carried("hand", np.array([carried]), 2.0)
        assert entries.unused() == left
    assert Declarations().unused() == []
    expect_refusal("cannot be read", read_declarations, tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[[carried]]", "[[carries]]", "got carries"),
        ("[[carried]]", "[carried]", r"write \[\[carried\]\]"),
        ('link = "hand"', 'link = "foot"', "its links: arm, hand"),
        ("start = 1", "begin = 1", "key 'begin'"),
        ("start = 1", "start = nan", "expected a finite number"),
        ("start = 1", "start = true", "expected a finite number"),
        ("start = 1", "start = 2.5", "expected start < end"),
        ("box = [-0.1, -0.1,", "box = [-0.1,", r"expected \[lx, ly, lz"),
        ("box = [-0.1, -0.1,", "box = [0.2, -0.1,", "lower corner below"),
        ('reason = "the peg goes into its hole"', 'reason = " "', "reason: expected words"),
        ("end = 2.5", "", "missing key 'end'"),
        ("[[carried]]", "[[carried", "not valid TOML"),
    ],
)
def test_what_is_wrong_is_refused_in_one_line_with_a_remedy(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in GOOD
    assert "contact.toml" in expect_refusal(words, declared, tmp_path, GOOD.replace(old, new, 1))
