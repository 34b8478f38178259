"""A wall of one colour: its scene, and recordings whose scores are known."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.formats.scene.scene_folder import ViewCorrection
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.geometry import look_at
from splatctrl_cli.jobs.score import reference as score_reference
from splatctrl_cli.jobs.score import score
from splatctrl_cli.records import Float64, Intrinsics, LossReport, Record, RgbdFrame, SplatSet
from splatctrl_cli.scene.render import render
from splatctrl_cli.voxels import OccupancyGrid
from tests.plain import plain_frame, plain_grid, plain_splats

INTRINSICS = Intrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
SECOND = 1_000_000_000


def wall(brightness: float = 0.5) -> SplatSet:
    """A dense wall in the plane x = 1, of one colour."""
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-0.8, 0.8, 0.02), np.arange(-0.8, 0.8, 0.02)))
    return plain_splats(np.column_stack([np.ones(len(y)), y, z]), 0.02, colors=brightness, opacities=0.95)


def frame(stamp_ns: int, camera: str, T_world_camera: Float64, color_offset: float = 0.0) -> RgbdFrame:
    """What a camera records of the wall; its colour is off by `color_offset`."""
    rendering = render(wall(), INTRINSICS, T_world_camera, threads=1)
    color = np.round(np.clip(255 * (rendering.color + color_offset), 0, 255))
    depth = rendering.normalised_depth()
    return plain_frame(depth, INTRINSICS, T_world_camera, stamp_ns=stamp_ns, camera=camera, color=color)


FRONT = look_at([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
SIDE = look_at([0.0, 0.1, 0.0], [1.0, 0.1, 0.0])
AWAY = look_at([0.0, 0.0, 0.0], [-1.0, 0.0, 0.0])


@dataclass(kw_only=True)
class FakeSource:
    """A recording from a list of frames."""

    frames: list[RgbdFrame]
    has_clock: bool = True
    name: str = "fake"
    joint_names: tuple[str, ...] = ()
    depth_fault: None = None
    loss: LossReport = field(default_factory=LossReport)

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(f.camera for f in self.frames))

    def records(self) -> Iterator[Record]:
        return iter(self.frames)

    def digests(self) -> dict[str, str]:
        return {"fake": "0"}


@dataclass(kw_only=True)
class FakeSnapshot:
    """A moment of which the scene knows."""

    stamp_ns: int


@dataclass(kw_only=True)
class FakeScene:
    """A scene whose wall is dark at first and right from second 2 on."""

    has_clock: bool = True
    cameras: tuple[str, ...] = ("cam0",)
    snapshots: tuple[FakeSnapshot, ...] = (FakeSnapshot(stamp_ns=SECOND), FakeSnapshot(stamp_ns=2 * SECOND))
    training_stamps_ns: frozenset[int] = frozenset()
    is_anisotropic: bool = False
    names_its_views: bool = True
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    corrections: dict[tuple[str, int], ViewCorrection] = field(default_factory=dict)
    run: dict[str, Any] = field(default_factory=lambda: {"config": {"occupancy": {"free_below": 0.3}}})

    def occupancy(self) -> OccupancyGrid:
        """One voxel of free space that holds the left half of the wall."""
        return plain_grid((1, 1, 1), 10.0, [1.0, 5.0, 0.0])

    def unrepresented_at(self, stamp_ns: int | None) -> None:
        return None

    def shell_at(self, stamp_ns: int | None) -> SplatSet | None:
        return None

    def splats(self) -> SplatSet:
        return wall()

    def splats_at(self, stamp_ns: int) -> SplatSet:
        return wall(0.4 if stamp_ns < 2 * SECOND else 0.5)


FRAMES = [
    *(frame(0, "cam0", FRONT), frame(0, "cam3", SIDE)),
    *(frame(SECOND, "cam0", FRONT), frame(SECOND, "cam3", SIDE)),
    *(frame(2 * SECOND, "cam3", SIDE, 0.01), frame(3 * SECOND, "cam3", AWAY)),
]


def write_scene(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, and the recording FRAMES."""
    (folder / "scene").mkdir()
    write_ply(folder / "scene" / "splats.ply", wall(), {})
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES))
    return folder


def set_up(monkeypatch: pytest.MonkeyPatch, scene: FakeScene, recording: FakeSource) -> None:
    """Every scene is `scene`, and every recording `recording`."""
    monkeypatch.setattr(score, "open_splats", lambda path: scene)
    monkeypatch.setattr(score_reference, "open_source", lambda path, options, **_: recording)
