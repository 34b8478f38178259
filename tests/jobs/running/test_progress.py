"""Waits: announced with their length, then told with what is left, and every warning with a remedy."""

import ast
from pathlib import Path

import pytest

import splatctrl_cli
from splatctrl_cli.jobs.running import progress
from splatctrl_cli.jobs.running.progress import Wait, duration
from tests.jobs.bake.baked import Said


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_wait_is_announced_and_says_how_long_it_still_is(clock: list[float]) -> None:
    said = Said()
    wait = Wait(said, "fits 31 views", "iterations", 300).announce()
    for _ in range(300):
        clock[0] += 0.5
        wait.step()
    assert said.lines[:2] == [
        "fits 31 views: 300 iterations",
        "fits 31 views: 20 of 300 iterations, about 2 min left",
    ]
    assert said.lines[-1] == "fits 31 views: 300 of 300 iterations"
    assert len(said.lines) == 16


def test_a_first_step_that_prepares_the_others_says_nothing_of_them(clock: list[float]) -> None:
    said = Said()
    wait = Wait(said, "fits 15 views", "iterations", 60).announce()
    for seconds in (180.0, *[5.0] * 2):
        clock[0] += seconds
        wait.step()
    assert said.lines[1:] == [
        "fits 15 views: 1 of 60 iterations",
        "fits 15 views: 3 of 60 iterations, about 5 min left",
    ]


def test_a_short_wait_is_only_announced(clock: list[float]) -> None:
    said = Said()
    wait = Wait(said, "refines", "iterations", 3).announce()
    for _ in range(5):
        wait.step()
    assert said.lines == ["refines: 3 iterations"]


def test_a_wait_of_unknown_length_tells_what_is_done(clock: list[float]) -> None:
    said = Said()
    wait = Wait(said, "scores cam3", "views").announce()
    clock[0] = 11.0
    wait.at(7)
    assert said.lines == ["scores cam3", "scores cam3: 7 views"]


@pytest.mark.parametrize(("seconds", "said"), [(0.2, "1 s"), (40, "40 s"), (340, "6 min"), (5000, "1 h 23 min")])
def test_durations_are_said_as_a_person_does(seconds: float, said: str) -> None:
    assert duration(seconds) == said


def warnings_in(path: Path) -> list[tuple[str, str]]:
    """The constant text of each f-string or string in a file that is a warning line."""
    texts = []
    nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    within = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in (node for node in nodes if id(node) not in within):
        parts = node.values if isinstance(node, ast.JoinedStr) else [node] if isinstance(node, ast.Constant) else []
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in parts)
        if "warning: " in text and text != "warning: {}":
            texts.append((path.name, text))
    return texts


def test_every_warning_has_a_remedy() -> None:
    rooms = Path(splatctrl_cli.__file__).parent
    found = [text for path in sorted(rooms.rglob("*.py")) for text in warnings_in(path)]
    assert len(found) > 6
    assert [text for text in found if ";" not in text[1] and not text[1].endswith("{}")] == []
