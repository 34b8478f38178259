"""Errors of `calibrate` on simulated set-ups: cameras about an arm at a table, with wrongly recorded poses.

    python -m benchmarks.calibration --setups 50 --csv bench_output/calibration.csv

Each set-up is a log of 30 frames a camera. Its seed draws cameras, objects, motion, errors of recorded poses, and the
clock of the joint states. In every second set-up, it also draws one camera's depth scale. A row of the CSV is one
unknown.
"""

import argparse
import csv
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import ROOT
from benchmarks.open3d_multiway import multiway
from benchmarks.random_tabletop import random_things
from splatctrl_cli.calibration.evidence import transform_of, twist_between
from splatctrl_cli.calibration.views import still_frame
from splatctrl_cli.cli.common import table
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.geometry import invert_transform, look_at
from splatctrl_cli.jobs.calibrate import CalibrateRequest, CalibrateResult, calibrate
from splatctrl_cli.recording.container.mcap_writer import mcap_log
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import Float64, JointState, Record, RgbdFrame, merge_by_stamp
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.arm import HAND, Motion
from splatctrl_cli.simulate.recording import (
    JOINT_RATE,
    NOISES,
    OPTICAL_FROM_LINK,
    START_NS,
    Recording,
    RecordingOptions,
    Scene,
    Transform,
)
from splatctrl_cli.simulate.render import Renderer

PLAIN = ROOT / "tests" / "data" / "tabletop"  # the arm of primitive shapes
ARM: dict[str, Any] = {"urdf": PLAIN / "robot.urdf", "spheres": PLAIN / "robot_spheres.yaml"}
OPTIONS = RecordingOptions(duration_s=6.0, fps=5.0, color_rays=0)
OFF = (np.radians(1.5), 0.02)  # [rad], [m]: standard deviations of recorded poses, about and along each axis
CLOCK = 0.06  # [s] at most
SCALE = 0.03  # of depths, at most
POSTURES = 0.25  # [rad] about the sample's waypoints
EYES = ((0.75, 0.6), (1.05, 1.0))  # [m] from the middle of the table, and above it
TARGETS = ((0.30, -0.10, 0.0), (0.45, 0.10, 0.15))  # [m] that cameras look at
WRIST = "wrist"
T_HAND_WRIST = np.array([[0, -1, 0, 0.08], [1, 0, 0, 0], [0, 0, 1, 0.02], [0, 0, 0, 1.0]]) @ transform_of(
    np.array([0.0, -0.25, 0.0, 0.0, 0.0, 0.0])
)
ALONE, OPEN3D = "cameras alone", "cameras alone, Open3D"
KINDS = ("robot", ALONE, "wrist", OPEN3D)
UNITS = {"position": ("mm", 1e3), "rotation": ("deg", 180 / np.pi), "clock": ("ms", 1e3), "depth scale": ("%", 1e2)}


class SetUp(Recording):
    """A seed's draw: three stationary cameras; or with `has_wrist`, one stationary camera and one on the hand."""

    def __init__(self, seed: int, options: RecordingOptions = OPTIONS, *, has_wrist: bool = False) -> None:
        self._rng = rng = np.random.default_rng([seed, 1])
        super().__init__(replace(options, seed=seed), RobotModel.from_urdf(**ARM), self._scene(seed, options))
        first = rng.uniform(0, 2 * np.pi)
        self.cameras = tuple(
            replace(camera, T_world_camera=_view(first + 2 * np.pi / 3 * number + rng.uniform(-0.4, 0.4), rng))
            for number, camera in enumerate(self.cameras[: 1 if has_wrist else 3])
        )
        self.has_wrist = has_wrist
        self.names = (*(camera.name for camera in self.cameras), *((WRIST,) if has_wrist else ()))
        self.off = {name: transform_of(rng.normal(0, np.repeat(OFF, 3))) for name in self.names}
        self.clock = float(rng.uniform(-CLOCK, CLOCK))
        self.scale = float(1 + rng.uniform(-SCALE, SCALE)) if seed % 2 else 1.0

    def _scene(self, seed: int, options: RecordingOptions) -> Scene:
        waypoints = np.array(tabletop.WAYPOINTS) + self._rng.uniform(-POSTURES, POSTURES, (3, 7))
        motion = Motion(times=np.array([0.06, 0.5, 0.94]) * options.duration_s, waypoints=waypoints)
        third = round(options.duration_s * 1e9) // 3
        visitor = tabletop.visitor(START_NS + third, START_NS + 2 * third)
        things = (*tabletop.furniture(), *random_things(seed), visitor)
        return Scene(primitives=things, temporary=(visitor,), motion=motion)

    def joint_states(self) -> Iterator[JointState]:
        """Joint states from before the first frame to after the last, by the robot's clock."""
        for index in range(-10, int(self.options.duration_s * JOINT_RATE) + 10):
            position, velocity = self._motion.at(index / JOINT_RATE)
            stamp_ns = self.start_ns + index * 10**9 // JOINT_RATE - round(self.clock * 1e9)
            yield JointState(stamp_ns=stamp_ns, position=position, velocity=velocity)

    def frames(self) -> Iterator[RgbdFrame]:
        """Frames of stationary cameras, the first with wrong depths, and of the moving camera."""
        for frame in super().frames():
            is_first = frame.camera == self.names[0]
            yield replace(frame, depth=frame.depth / np.float32(self.scale)) if is_first else frame
            if self.has_wrist:
                yield self._from_hand(frame.stamp_ns)

    def _from_hand(self, stamp_ns: int) -> RgbdFrame:
        poses = self.link_poses(self._motion.at((stamp_ns - self.start_ns) * 1e-9)[0])
        camera = replace(self.cameras[0], name=WRIST, T_world_camera=poses[HAND] @ T_HAND_WRIST)
        arm = tabletop.arm_solids(self.robot.urdf.shapes, poses)
        depth = Renderer(camera, [*self.primitives[:-1], *arm], color_rays=0).depth([])
        noise = NOISES[self.options.noise]
        if noise is not None:
            depth = noise.applied(depth, np.random.default_rng([self.options.seed, stamp_ns]))
        return RgbdFrame(
            stamp_ns=stamp_ns,
            camera=WRIST,
            color=np.zeros((*depth.shape, 3), np.uint8),
            depth=depth,
            intrinsics=camera.intrinsics,
            T_world_camera=camera.T_world_camera,
        )

    def records(self) -> Iterator[Record]:
        """By stamp."""
        return merge_by_stamp(self.joint_states(), self.frames())

    def static_transforms(self) -> list[Transform]:
        """The cameras where they are taken to be."""
        transforms: list[Transform] = [("world", self.robot.urdf.links[0], self.robot.T_world_base)]
        mounts = [("world", camera.name, camera.T_world_camera) for camera in self.cameras]
        for parent, name, T in [*mounts, *([(HAND, WRIST, T_HAND_WRIST)] if self.has_wrist else [])]:
            transforms.append((parent, f"{name}_link", T @ self.off[name] @ OPTICAL_FROM_LINK.T))
            transforms.append((f"{name}_link", f"{name}_optical_frame", OPTICAL_FROM_LINK))
        return transforms


def write_log(setup: SetUp, path: Path) -> None:
    """Its log."""
    with mcap_log(path) as log:
        log.add_transforms(setup.start_ns, setup.static_transforms(), is_static=True)
        for record in setup.records():
            if isinstance(record, JointState):
                log.add_joint_state(record, setup.robot.joint_names)
                if setup.has_wrist:
                    log.add_transforms(record.stamp_ns, setup.link_transforms(record.position), is_static=False)
            else:
                log.add_frame(record)


def _view(angle: float, rng: np.random.Generator) -> Float64:
    """T_world_camera (4, 4) from an angle [rad] about the table's middle."""
    distance, height = rng.uniform(*EYES)
    eye = [0.38 + distance * np.cos(angle), distance * np.sin(angle), height]
    return look_at(eye, rng.uniform(*TARGETS))


@dataclass(frozen=True, kw_only=True)
class Error:
    """One axis of an unknown, or one number: its error and its stated sigma [m, rad, s or of 1]."""

    kind: str
    seed: int
    camera: str
    unknown: str
    axis: int
    error: float
    sigma: float


def errors(kind: str, setup: SetUp, result: CalibrateResult) -> Iterator[Error]:
    """Errors of each unknown, along and about the axes of its sigmas in the file."""
    named: dict[str, Any] = {"kind": kind, "seed": setup.options.seed}
    cameras = {camera.name: camera.T_world_camera for camera in setup.cameras}
    for name, found in result.calibration.cameras.items():
        truth = invert_transform(setup.off[name]) if found.moves else cameras[name]
        twist = twist_between(truth, found.T)
        R = np.eye(3) if found.moves else truth[:3, :3]
        if "pose" not in found.as_recorded:
            for unknown, error, sigma in (
                ("position", R @ twist[3:], found.sigma_position),
                ("rotation", R @ twist[:3], found.sigma_rotation),
            ):
                for axis in range(3):
                    yield Error(
                        **named, camera=name, unknown=unknown, axis=axis, error=float(error[axis]), sigma=sigma[axis]
                    )
        if "depth scale" not in found.as_recorded:
            apart = found.scale - (setup.scale if name == setup.names[0] else 1.0)
            yield Error(**named, camera=name, unknown="depth scale", axis=0, error=apart, sigma=found.sigma_depth[0])
    if result.calibration.clock is not None:
        late = result.calibration.clock - setup.clock
        yield Error(**named, camera="", unknown="clock", axis=0, error=late, sigma=result.calibration.sigma_clock)


def errors_of_open3d(setup: SetUp, log: Path) -> Iterator[Error]:
    """Errors of Open3D's multiway registration of each camera's `still_frame`; Open3D states no sigma."""
    frames = [record for record in open_source(log).records() if isinstance(record, RgbdFrame)]
    still = [still_frame([frame for frame in frames if frame.camera == name]) for name in setup.names]
    for camera, T in list(zip(setup.cameras, multiway(still), strict=True))[1:]:
        twist = twist_between(camera.T_world_camera, T)
        for unknown, values in (("position", twist[3:]), ("rotation", twist[:3])):
            for axis, error in enumerate(values.tolist()):
                yield Error(
                    kind=OPEN3D,
                    seed=setup.options.seed,
                    camera=camera.name,
                    unknown=unknown,
                    axis=axis,
                    error=error,
                    sigma=np.nan,
                )


def trial(kind: str, seed: int, folder: Path) -> list[Error]:
    """Errors of one set-up of a kind. Raises NotEvaluableError if `calibrate` does."""
    setup = SetUp(seed, has_wrist=kind == "wrist")
    if kind in (ALONE, OPEN3D):
        setup.off[setup.names[0]] = np.eye(4)
        setup.scale = 1.0  # of the camera that is held, nothing else tells it
    log = folder / "log.mcap"
    write_log(setup, log)
    if kind == OPEN3D:
        return list(errors_of_open3d(setup, log))
    robot: dict[str, Any] = {} if kind == ALONE else ARM
    result = calibrate(CalibrateRequest(paths=(log,), out=folder / "calibration.toml", force=True, **robot))
    return list(errors(kind, setup, result))


def lines(rows: Sequence[Error]) -> Iterator[str]:
    """A table: errors by kind and unknown, as lengths per camera, and the share of axes within two sigma."""
    header = ("set-up", "error of", "", "median", "95 %", "largest", "stated sigma", "within 2 sigma")
    shown = []
    for kind in KINDS:
        for unknown, (unit, factor) in UNITS.items():
            some = [row for row in rows if (row.kind, row.unknown) == (kind, unknown)]
            if not some:
                continue
            error, sigma = (factor * np.array([getattr(row, name) for row in some]) for name in ("error", "sigma"))
            length = np.linalg.norm(error.reshape(-1, 3 if unknown in ("position", "rotation") else 1), axis=1)
            figures = (np.median(length), np.percentile(length, 95), length.max(), np.median(sigma))
            within = int((np.abs(error) <= 2 * sigma).sum())
            share = "-" if np.isnan(sigma).any() else f"{within} of {len(some)} ({within / len(some):.1%})"
            shown.append(
                [kind, unknown, unit, *("-" if np.isnan(value) else f"{value:.3f}" for value in figures), share]
            )
    yield from table(header, shown)


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate every set-up, print the table and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--setups", type=int, default=50)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS[:3])
    parser.add_argument("--csv", type=Path, default=Path("bench_output/calibration.csv"))
    args = parser.parse_args(argv)
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    rows: list[Error] = []
    refused: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for seed, kind in ((seed, kind) for seed in range(args.setups) for kind in args.kinds):
            try:
                rows += trial(kind, seed, Path(folder))
            except NotEvaluableError as refusal:
                refused.append(f"{kind}, seed {seed}: {refusal.message}")
            with args.csv.open("w", newline="", encoding="utf-8") as stream:
                writer = csv.DictWriter(stream, fieldnames=list(Error.__dataclass_fields__), lineterminator="\n")
                writer.writeheader()
                writer.writerows(asdict(row) for row in rows)
    print("\n".join(lines(rows)))
    print(f"refused: {len(refused)} of {args.setups * len(args.kinds)}")
    print("\n".join(refused))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
