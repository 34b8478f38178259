"""A log of joint states, scenes with a known answer, and a folder to replay one against the other in."""

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.files.output import part_digests
from splatctrl_cli.formats.grid.npz_grid import write_npz
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.recording.log.state_columns import StateCollector, StateColumns
from splatctrl_cli.records import Box, Float64, JointState, LossReport, Record, SplatSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import OccupancyGrid
from tests.plain import known, plain_grid, plain_splats

SECOND = 1_000_000_000
START = np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.0])
BALL = ((0.75, 0.45, 0.40), 0.05)
AROUND = Box(lower=np.array([-0.4, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.2]))


@dataclass(kw_only=True)
class FakeSource:
    """A recording of joint states alone."""

    states: Sequence[JointState]
    joint_names: tuple[str, ...] = tuple(f"joint{i}" for i in range(1, 8))
    cameras: tuple[str, ...] = ("cam0",)
    name: str = "fake.mcap"
    has_clock: bool = True
    loss: LossReport = field(default_factory=LossReport)
    tf_frames: Mapping[str, Float64 | None] = field(default_factory=dict)

    def __setattr__(self, name: str, value: Any) -> None:
        """States are kept as columns, as logs have them."""
        object.__setattr__(self, name, columns_of(value) if name == "states" else value)

    def records(self) -> Iterator[Record]:
        yield from self.states

    def digests(self) -> dict[str, str]:
        return {"fake.mcap": "0" * 64}


def columns_of(states: Sequence[JointState]) -> StateColumns:
    """Joint states as columns."""
    collector = StateCollector(len(states[0].position) if states else 0)
    for state in states:
        collector.add(state)
    return collector.columns()


def logged(end: Float64 = START, num: int = 11, start_ns: int = 0) -> list[JointState]:
    """States at 10 Hz on the straight way from START to `end`."""
    return [
        JointState(stamp_ns=start_ns + i * SECOND // 10, position=START + f * (end - START), velocity=np.zeros(7))
        for i, f in enumerate(np.linspace(0, 1, num))
    ]


def splats_of(*balls: tuple[tuple[float, float, float], float]) -> SplatSet:
    return plain_splats([ball[0] for ball in balls], [ball[1] for ball in balls])


def grid_seen(is_seen: bool = True) -> OccupancyGrid:
    return plain_grid((40, 40, 40), 0.1, [-1.5, -1.5, -1.0], log_odds=-1.0, num_updates=int(is_seen))


def write_scene(
    folder: Path, *snapshots: tuple[int, SplatSet], is_seen: bool = True, unrepresented: ArrayLike = ()
) -> Path:
    """A scene of these snapshots; voxels of 10 cm at `unrepresented` (K, 3) [m] have no splat at any time."""
    folder.mkdir()
    writer = SceneWriter(folder, {"frame": "world"})
    for stamp_ns, splats in snapshots:
        voxels = known(grid_seen(is_seen), stamp_ns, unrepresented)
        writer.snapshot(stamp_ns, splats, voxels, voxels.grid.states(0.3, 0.7))
    writer.finish(*snapshots[-1], known(grid_seen(is_seen), snapshots[-1][0], unrepresented))
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": snapshots[-1][0]}
    (folder / "run.json").write_text(json.dumps({"metrics": metrics, "parts": part_digests(folder)}))
    return folder


def write_field(
    folder: Path,
    *balls: tuple[tuple[float, float, float], float],
    box: Box = AROUND,
    seen: OccupancyGrid | None = None,
    moment_ns: int | None = None,
    **field: Any,
) -> Path:
    """A field baked of balls, that of a moment where one is given; all was seen unless `seen` says otherwise."""
    occupancy = grid_seen() if seen is None else seen
    grid = bake(splats_of(*balls), box, FieldConfig(**field), occupancy=occupancy, threads=1)
    header = grid.header if moment_ns is None else {**grid.header, "stamp_ns": moment_ns}
    folder.mkdir()
    write_npz(folder / "field.npz", replace(grid, header=header))
    return folder


@dataclass(kw_only=True)
class Desk:
    """A folder to work in, a source that stands for the log, and the robot's files."""

    folder: Path
    source: FakeSource
    robot: list[str]

    def replay(self, *arguments: str, out: str = "out", is_judged: bool = False) -> int:
        """The exit code; without `is_judged` the verdict does not turn it."""
        log, judged = str(self.folder / "fake.mcap"), [] if is_judged else ["--report-only"]
        return main(["replay", log, *self.robot, "-o", str(self.folder / out), *judged, *arguments])

    def json(self, name: str, out: str = "out") -> Any:
        """A file of a run."""
        return json.loads((self.folder / out / name).read_text())

    def verdict(self, out: str = "out") -> Any:
        return self.json("summary.json", out)["verdict"]

    def metrics(self, out: str = "out") -> Any:
        return self.json("summary.json", out)["metrics"]

    def rows(self, out: str = "out") -> list[dict[str, str]]:
        with (self.folder / out / "steps.csv").open() as stream:
            return list(csv.DictReader(stream))


def scene_of(desk: Desk, *balls: tuple[tuple[float, float, float], float]) -> tuple[str, str]:
    """The option that names a scene of these balls, which is written now."""
    return "--scene", str(write_scene(desk.folder / "scene", (0, splats_of(*balls))))


def clearance(arm: RobotModel, q: Float64, ball: tuple[tuple[float, float, float], float] = BALL) -> float:
    gap = np.linalg.norm(arm.sphere_centers(q) - np.array(ball[0]), axis=1) - arm.sphere_set.radii - ball[1]
    return float(gap[arm.moving_spheres].min())
