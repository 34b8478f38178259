"""One run that is safe, and what it takes to break one thing of it."""

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import ArrayLike

from splatctrl_cli.files.output import part_digests, write_json
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Box, Float64, JointState, Label, LossReport, SplatSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.primitives import Primitive, Texture
from splatctrl_cli.simulate.truth import Truth, truth_document
from splatctrl_cli.voxels import Balls, KnownVoxels, VoxelState
from tests.cli.replay_desk import SECOND, START, Desk, grid_seen, splats_of, write_field
from tests.plain import known

FAR = ((-1.0, 0.0, 1.3), 0.05)  # a ball behind the arm
MOVE = np.array([0.5, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
QUARTER = SECOND // 4
Ball = tuple[tuple[float, float, float], float]


def states_on(positions: Float64, *, step_ns: int = SECOND // 10, start_ns: int = 0) -> list[JointState]:
    """States at postures (T, 7), by default at 10 Hz."""
    return [
        JointState(stamp_ns=start_ns + i * step_ns, position=np.asarray(q, np.float64), velocity=np.zeros(7))
        for i, q in enumerate(positions)
    ]


def resting(q: Float64 = START, num: int = 11) -> list[JointState]:
    """The arm at q for (num - 1) / 10 s."""
    return states_on(np.tile(q, (num, 1)))


def passing(move: Float64 = MOVE, num: int = 11) -> list[JointState]:
    """The straight way from START to START + move."""
    return states_on(START + np.linspace(0, 1, num)[:, None] * move)


def ball_beside(arm: RobotModel, q: Float64, gap: float, *, way: Float64 | None = None, radius: float = 0.05) -> Ball:
    """A ball whose surface is `gap` [m] from the moving arm at q; at the other postures of a way (T, J) the arm is
    further from it.
    """
    moving = np.flatnonzero(arm.moving_spheres)
    radii, centers = arm.sphere_set.radii[moving], arm.sphere_centers(q)[moving]
    others = np.zeros((0, len(moving), 3)) if way is None else arm.sphere_centers_batch(way)[:, moving]
    generator = np.random.default_rng(3)
    for nearest, away in zip(generator.integers(-12, 0, 2000), generator.normal(size=(2000, 3)), strict=True):
        out = away / np.linalg.norm(away)
        center = centers[nearest] + (radii[nearest] + gap + radius) * out
        gaps = np.linalg.norm(centers - center, axis=1) - radii - radius
        before = np.linalg.norm(others - center, axis=2) - radii - radius
        if np.argmin(gaps) == nearest + len(gaps) and before.min(initial=np.inf) > gap + 0.002:
            return (float(center[0]), float(center[1]), float(center[2])), radius
    raise AssertionError


@dataclass(frozen=True)
class Beside:
    """A ball whose surface is `gap` [m] from the arm at q, by default at its last state and further off before."""

    gap: float
    q: Float64 | None = None
    radius: float = 0.05
    is_at_mount: bool = False  # behind the base instead, `gap` from its hindmost sphere, which no joint moves


@dataclass(kw_only=True)
class Stage:
    """What a replay is made of; by default of one that is safe: nothing is near, all is seen, four maps a second."""

    desk: Desk
    arm: RobotModel
    states: Sequence[JointState] = field(default_factory=passing)
    balls: Sequence[Ball | Beside] = (FAR,)
    later: Sequence[Ball | Beside] = ()
    later_from: int = SECOND // 2  # [ns] from which these are there
    are_later_people: bool = False
    people: Sequence[Ball | Beside] = ()
    true: Sequence[Ball | Beside] = ()  # what a truth has, where there is one
    baked: dict[str, Any] | None = None  # settings of a field of the balls, by which the states are judged
    map_stamps: Sequence[int] = tuple(i * QUARTER for i in range(5))
    unrepresented: ArrayLike = ()
    last_seen: KnownVoxels | None = None  # instead of all that was seen at the time of each map
    metrics: dict[str, Any] = field(default_factory=dict)  # of the scene's run.json, besides those of every scene
    loss: LossReport = field(default_factory=LossReport)
    smaller: dict[str, float] = field(default_factory=dict)  # by link, what its spheres lack of their radii [m]

    def scene(self, name: str = "scene") -> Path:
        """Its folder, written now."""
        self.place()
        folder = self.desk.folder / name
        folder.mkdir()
        writer = SceneWriter(folder, {"frame": "world"})
        for stamp_ns in self.map_stamps:
            voxels = self._voxels(stamp_ns)
            states = np.where(voxels.last_seen > 0, voxels.grid.states(0.3, 0.7), np.uint8(VoxelState.NEVER_SEEN))
            writer.snapshot(stamp_ns, self._splats(stamp_ns), voxels, states)
        last = self.map_stamps[-1]
        writer.finish(last, self._splats(last), self._voxels(last))
        metrics = {"cameras": ["cam0", "cam1", "cam2"], "has_clock": True, "stamp_ns": last, **self.metrics}
        run = {"command": "reconstruct", "arguments": [], "metrics": metrics, "parts": part_digests(folder)}
        write_json(folder / "run.json", run)
        return folder

    def bake(self) -> Path:
        """The folder of a field of the balls, written now."""
        self.place()
        box = Box(lower=np.array([-1.2, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.4]))
        return write_field(self.desk.folder / "field", *self.balls, box=box, **{"voxel": 0.04} | (self.baked or {}))

    def place(self) -> None:
        """Balls beside the arm get their places."""
        self.balls, self.later, self.people, self.true = (
            [self.placed(ball) for ball in balls] for balls in (self.balls, self.later, self.people, self.true)
        )

    def placed(self, ball: Ball | Beside) -> Ball:
        if not isinstance(ball, Beside):
            return ball
        if ball.is_at_mount:
            return beside_the_mount(self.arm, ball.gap)
        *way, end = (state.position for state in self.states)
        at, before = (end, np.array(way)) if ball.q is None else (ball.q, None)
        return ball_beside(self.arm, at, ball.gap, way=before, radius=ball.radius)

    def judged(self, *arguments: str, mode: str = "audit", scene: Path | None = None) -> tuple[int, dict[str, Any]]:
        """Exit code and verdict of the replay."""
        self.desk.source.states, self.desk.source.loss = self.states, self.loss
        where = ("--scene", str(scene or self.scene())) if self.baked is None else ("--field", str(self.bake()))
        true = ("--truth", str(self.truth(*self.true))) if self.true else ()
        return self.replayed(*where, *true, "--mode", mode, *arguments)

    def expect(
        self, code: int, broken: dict[str, str], *arguments: str, says: str = "", label: str = "", **given: Any
    ) -> dict[str, Any]:
        """The verdict of a replay that ends with `code`, where the criteria in `broken` alone did not pass."""
        found, verdict = self.judged(*arguments, **given)
        assert (found, decisive(verdict)) == (code, broken), verdict["sentence"]
        assert label in ("", verdict["label"]) and says in verdict["sentence"]
        return verdict

    def replayed(self, *arguments: str) -> tuple[int, dict[str, Any]]:
        """Exit code and verdict of a replay against any scene; no verdict where it did not come to one."""
        *robot, spheres = self.desk.robot
        if self.smaller:
            spheres = str(smaller_spheres(Path(spheres), self.desk.folder / "smaller.yaml", self.smaller))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(self.desk, "robot", [*robot, spheres])
            code = self.desk.replay(*arguments, "-q", "--force", is_judged=True)
        return code, self.desk.verdict() if (self.desk.folder / "out").exists() else {}

    def truth(self, *balls: Ball, name: str = "ball") -> Path:
        """A truth.json of these balls, called `name` and a number, beside the states."""
        robot = Path(self.desk.robot[1]), Path(self.desk.robot[3])
        primitives = tuple(sphere(f"{name}{i}", *ball) for i, ball in enumerate(balls))
        truth = Truth(
            path=self.desk.folder / "truth.json",
            primitives=primitives,
            cameras=(),
            luminance_std={},
            joint_names=tuple(self.arm.joint_names),
            robot_urdf=robot[0],
            robot_spheres=robot[1],
            T_world_base=np.eye(4),
            stamps=np.array([s.stamp_ns for s in self.states], np.int64),
            clearance=np.zeros(len(self.states)),
        )
        moving = np.flatnonzero(self.arm.moving_spheres)
        radii = self.arm.sphere_set.radii[moving]
        gaps = [truth.distance(self.arm.sphere_centers(s.position)[moving], s.stamp_ns) - radii for s in self.states]
        document = truth_document(replace(truth, clearance=np.array([gap.min() for gap in gaps])))
        for file in robot:
            (self.desk.folder / file.name).write_bytes(file.read_bytes())
        write_json(truth.path, document)
        return truth.path

    def ball_at_the_end(self, gap: float, radius: float = 0.05) -> Ball:
        """A ball that the arm is `gap` [m] from at its last state, and further from before."""
        return self.placed(Beside(gap, radius=radius))

    def _splats(self, stamp_ns: int) -> SplatSet:
        later = self.later if stamp_ns >= self.later_from else ()
        splats = splats_of(*self.balls, *later, *self.people)
        splats.labels[len(self.balls) + (0 if self.are_later_people else len(later)) :] = Label.HUMAN
        return splats

    def _voxels(self, stamp_ns: int) -> KnownVoxels:
        if self.last_seen is not None:
            return self.last_seen
        return known(grid_seen(), stamp_ns, self.unrepresented)


def beside_the_mount(arm: RobotModel, gap: float = -0.01) -> Ball:
    """A ball behind the base, `gap` from its hindmost sphere, which no joint moves."""
    x, y, z = arm.sphere_centers(START)[0]
    assert not arm.moving_spheres[0]
    return (float(x - arm.sphere_set.radii[0] - gap - 0.01), float(y), float(z)), 0.01


def smaller_spheres(spheres: Path, path: Path, smaller: dict[str, float]) -> Path:
    """The spheres of a file, less by link what is given [m]; those of which nothing is left are left out."""
    document = yaml.safe_load(spheres.read_text())
    for link, less in smaller.items():
        of_link = document["collision_spheres"].pop(link)
        if left := [one | {"radius": one["radius"] - less} for one in of_link if one["radius"] > less]:
            document["collision_spheres"][link] = left
    path.write_text(yaml.safe_dump(document))
    return path


def sphere(name: str, center: tuple[float, float, float], radius: float) -> Primitive:
    T = pose_at(center)
    texture = Texture(pattern="noise", feature=0.1, dark=(0.0, 0.0, 0.0), bright=(1.0, 1.0, 1.0))
    return Primitive(name=name, kind="sphere", size=(radius,), T_world_shape=T, texture=texture)


def voxels(seen_ns: int = 0, *, is_seen: ArrayLike = True, is_known: ArrayLike = True) -> KnownVoxels:
    """Voxels of which those of `is_seen` were last seen at one stamp, and those of `is_known` were ever."""
    grid = grid_seen()
    grid.num_updates[:] = is_known
    return KnownVoxels(
        grid=grid,
        last_seen=np.broadcast_to(np.asarray(is_seen, np.uint16), grid.num_updates.shape).copy(),
        step_stamps_ns=np.array([seen_ns], np.int64),
        unrepresented=Balls.from_voxels(np.zeros((0, 3), np.float32), grid.voxel, np.zeros(0, np.uint8)),
    )


def unseen_about(place: ArrayLike, reach: float) -> KnownVoxels:
    """Voxels that were all seen but those within `reach` [m] of a place (3,)."""
    grid = grid_seen()
    index = np.stack(np.indices(grid.num_updates.shape), axis=-1)
    return voxels(is_seen=np.linalg.norm(grid.origin + grid.voxel * index - np.asarray(place), axis=-1) > reach)


def decisive(verdict: dict[str, Any]) -> dict[str, str]:
    """Outcome by criterion of what did not pass."""
    return {r["criterion"]: r["outcome"] for r in verdict["reasons"] if r["outcome"] != "passed"}


Runs = Callable[..., Path]


@pytest.fixture
def run(desk: Desk, arm: RobotModel, monkeypatch: pytest.MonkeyPatch) -> Runs:
    """A replay in which a ball comes near, as the command leaves it; its scene and robot beside it."""

    def made(out: str = "audit", mode: str = "audit", *more: str) -> Path:
        stage = Stage(desk=desk, arm=arm, later=[Beside(0.012)])
        desk.source.states = stage.states
        if not (desk.folder / "scene").exists():
            stage.scene()
        words = ["--scene", "scene", "--urdf", desk.robot[1], "--spheres", desk.robot[3]]
        monkeypatch.setattr(sys, "argv", ["splatctrl", "replay", "fake.mcap", *words, "--mode", mode])
        monkeypatch.chdir(desk.folder)
        desk.replay(*words[:2], "--mode", mode, "-q", *more, out=out)
        folder = desk.folder / out
        cv2.imwrite(str(folder / "worst_1.png"), np.full((90, 1200, 3), 200, np.uint8))
        patch_json(folder / "run.json", lambda found: found | {"parts": part_digests(folder)})
        return folder

    return made


def patch_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def contents(folder: Path) -> dict[str, Any]:
    """Bytes by name, of run.json all but the timings and the command line."""
    found: dict[str, Any] = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    run = json.loads(found["run.json"])
    del run["seconds"], run["arguments"]
    return found | {"run.json": run}


def failing(real: Callable[..., Any], when: int, error: BaseException) -> Callable[..., Any]:
    """`real`, but its call number `when` raises: after half of its work where that is a file, else before any."""
    calls = 0

    def call(path: Any, *rest: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == when and not isinstance(path, Path):
            raise error
        result = real(path, *rest, **named)
        if calls == when:
            os.truncate(path, path.stat().st_size // 2)
            raise error
        return result

    return call


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt
