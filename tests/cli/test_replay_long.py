"""Replays whose states come in blocks: the same to the bit, and events that cross a border are one."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.control.events import EventFold, EventKind, Signal, events_of
from splatctrl_cli.files import rows
from splatctrl_cli.jobs.replays import files, record, store
from splatctrl_cli.logs import state_columns
from splatctrl_cli.records import JointState
from tests.cli.replay_desk import BALL, SECOND, START, Desk, logged, splats_of, write_scene

FILES = ("steps.csv", "events.json", "summary.json", "states.json")


def in_blocks_of(monkeypatch: pytest.MonkeyPatch, num: int) -> None:
    for module in (files, record, store, rows, state_columns):
        monkeypatch.setattr(module, "CHUNK" if module is files else "BLOCK", num)


@pytest.mark.parametrize("mode", ["audit", "open-loop", "closed-loop"])
@pytest.mark.usefixtures("without_plots")
def test_blocks_of_any_size_give_the_same_files(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, sample_data: Path, mode: str
) -> None:
    move = np.array([0.5, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    desk.source.states = [
        JointState(stamp_ns=s.stamp_ns, position=s.position, velocity=move) for s in logged(START + move, num=24)
    ]
    near = ((0.45, 0.1, 0.6), 0.05)
    scene = write_scene(
        desk.folder / "scene",
        (SECOND // 5, splats_of(BALL)),
        (SECOND, splats_of(BALL, near)),
        (SECOND * 2, splats_of(BALL)),
    )
    document = json.loads((sample_data / "tabletop" / "truth.json").read_text())
    stamps = [state.stamp_ns for state in desk.source.states]
    document["clearance"] |= {"stamps": stamps, "distance": [0.0] * len(stamps)}
    (desk.folder / "truth.json").write_text(json.dumps(document))
    truth = ("--truth", str(desk.folder / "truth.json"))
    more = {"audit": truth, "open-loop": (), "closed-loop": ("--follow",)}[mode]
    for num in (1, 7, 10_000):
        in_blocks_of(monkeypatch, num)
        assert desk.replay("--scene", str(scene), "-q", "--mode", mode, *more, out=str(num)) == 0
    for file in FILES:
        whole = (desk.folder / "10000" / file).read_bytes()
        assert all((desk.folder / out / file).read_bytes() == whole for out in ("1", "7")), file


def signals(values: Sequence[float], names: Sequence[str]) -> list[Signal]:
    value = np.array(values)
    low = Signal(
        kind=EventKind.BELOW_MARGIN, is_on=value < 1, value=value, names_at=lambda i: [names[i]], is_high_worse=False
    )
    return [low, Signal(kind=EventKind.LIMIT, is_on=value > 2, value=value, names_at=lambda i: [names[i]])]


@pytest.mark.parametrize("size", [1, 2, 3, 5, 12])
def test_an_event_that_crosses_blocks_is_one(size: int) -> None:
    values = [0.5, 0.2, 0.9, 0.2, 3.0, 4.0, 4.0, 1.5, 0.1, 5.0, 5.0, 0.3]
    names = list("abacddefghij")
    stamps = np.arange(12, dtype=np.int64) * 1_000_000
    fold = EventFold()
    for first in range(0, 12, size):
        part = slice(first, first + size)
        fold.add(stamps[part], signals(values[part], names[part]))
    found = fold.events()
    assert found == events_of(stamps, signals(values, names))
    first = found[0]
    assert (first.num_states, first.worst, first.state, first.worst_name) == (4, 0.2, 1, "b")
    assert first.names == ("a", "b", "c") and [event.num_states for event in found] == [4, 3, 1, 2, 1]


def test_stored_objects_are_those_of_a_list_over_the_borders_of_blocks() -> None:
    stored: store.StoredObjects[int] = store.StoredObjects()
    for block in ([0, 1], [], [2, 3, 4], [5]):
        stored.extend(block)
    whole = list(range(6))
    assert list(stored) == whole and stored[-1] == 5 and stored[4:1:-1] == whole[4:1:-1]
    assert all(stored[i:j] == whole[i:j] for i in range(-7, 8) for j in range(-7, 8))


def test_the_first_time_in_unknown_space_is_named(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)), is_seen=False)
    assert desk.replay("--scene", str(scene), "-q", is_judged=True) == 5
    assert "allowed 5 %, first at 0.00 s" in capsys.readouterr().err


def test_a_gate_on_poses_that_the_log_lacks_fails(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q", "--require", "max_pose_position<=0.01") == 5
    assert "max_pose_position is unknown" in capsys.readouterr().err
    assert desk.metrics()["num_poses"] == 0
