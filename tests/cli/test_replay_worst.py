"""``splatctrl replay --worst-frames``."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest

from splatctrl_cli.records import Record
from tests.cli.replay_desk import BALL, SECOND, START, Desk, FakeSource, logged, splats_of, write_scene
from tests.evaluate.test_worst_frames import frame


@dataclass(kw_only=True)
class FilmedSource(FakeSource):
    """A recording of an arm with a camera above it."""

    def records(self) -> Iterator[Record]:
        yield from sorted([*self.states, *(frame(k * SECOND // 5) for k in range(6))], key=lambda r: r.stamp_ns)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("worst_*")}


def test_a_replay_shows_its_worst_moments(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    desk.source = FilmedSource(states=logged(START + 0.3))
    scene = ["--scene", str(write_scene(desk.folder / "scene", (0, splats_of(BALL)))), "-q"]
    for mode in ("audit", "closed-loop"):
        assert desk.replay(*scene, "--mode", mode, "--set", "control.max_time=0.5", out=mode) == 0
        assert names(desk.folder / mode) >= {"worst_1.png"}
        picture = cv2.imread(str(desk.folder / mode / "worst_1.png"))
        assert picture is not None and picture.shape[1] == 960
    assert desk.replay(*scene, "--worst-frames", "0", out="none") == 0
    assert not names(desk.folder / "none")


def test_a_log_without_cameras_says_that_there_is_no_picture(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = str(write_scene(desk.folder / "scene", (0, splats_of(BALL))))
    desk.source.states = logged(START + 0.3)
    assert desk.replay("--scene", scene) == 0
    assert "worst frames: no camera image at or before 1 of 1 moments" in capsys.readouterr().out
    assert not names(desk.folder / "out")
    assert desk.replay("--scene", scene, "--worst-frames", "x", out="bad") == 2
