"""The true scene: a table with objects on it, the arm's motion, and one target at a chosen clearance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatctrl_cli.geometry import (
    frame_along,
    invert_transform,
    look_at,
    pose_at,
    project,
    transform_points,
    turn_about_z,
)
from splatctrl_cli.records import Box, Float64, Intrinsics
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import Capsule, Motion
from splatctrl_cli.simulate.primitives import ALWAYS, Primitive, Texture, Track
from splatctrl_cli.simulate.recording import START_NS
from splatctrl_cli.simulate.render import Camera
from splatctrl_cli.simulate.tabletop import PALETTE
from tools.hunt.body import WIDTH, Body
from tools.hunt.clearance import Stamps, TrueArm

BOX = Box(lower=np.array([-0.30, -0.70, -0.06]), upper=np.array([0.95, 0.70, 1.00]))
DURATION_S = 3.2
FPS = 5.0
NUM_FRAMES = round(DURATION_S * FPS)
CENTRE = np.array([-0.1, 0.1, 0.0, -1.9, 0.0, 2.1, 0.4])  # [rad] about which starts are drawn
SPREAD = np.array([0.9, 0.35, 0.4, 0.4, 0.5, 0.4, 0.8])
TURN = np.array([0.8, 0.35, 0.3, 0.35, 0.4, 0.4, 0.6])  # [rad] from start to end at most
NUM_SAMPLES = 27  # of the motion, while a target is placed
NS = 1_000_000_000

Made = tuple[Primitive, ...]
Make = Callable[[Float64], Made]  # the target's solids with its middle at (3,) [m]


@dataclass(frozen=True, kw_only=True)
class World:
    """The truth of one run: `things` stand throughout; `targets` are the family's objects.

    wrist: a camera on the hand, with T_hand_camera as its pose. tool: a capsule on the true arm's hand that no model
    has. body: the arm's visual shapes and depth. people: names of the targets in masks.
    """

    motion: Motion
    things: Made
    targets: Made
    cameras: tuple[Camera, ...]
    wrist: Camera | None = None
    tool: Capsule | None = None
    body: Body = field(default_factory=Body)
    people: frozenset[str] = frozenset()

    @property
    def primitives(self) -> Made:
        """Everything but the arm."""
        return self.things + self.targets

    def positions(self, stamps: Stamps) -> Float64:
        """Joint positions (T, J) of the recorded motion."""
        return positions_of(self.motion, stamps)


def positions_of(motion: Motion, stamps: Stamps) -> Float64:
    """Joint positions (T, J) of a motion at stamps (T,) [ns]."""
    return np.array([motion.at((int(stamp) - START_NS) / NS)[0] for stamp in stamps])


def at_s(second: float) -> int:
    """The stamp [ns] of a time since the start [s]."""
    return START_NS + round(second * NS)


def samples() -> Stamps:
    """Stamps (NUM_SAMPLES,) over the recording."""
    return np.linspace(START_NS, at_s(DURATION_S), NUM_SAMPLES).astype(np.int64)


def table() -> Primitive:
    """The table's top; the room beyond the workspace is left out."""
    return _solid("table", "box", (1.5, 1.5, 0.05), np.array([0.35, 0.0, -0.025]), np.random.default_rng(1))


def draw_motion(
    rng: np.random.Generator, model: RobotModel, arm: TrueArm, cameras: Sequence[Camera], turn: Float64 = TURN
) -> Motion:
    """One stroke between two rests, clear of the table, the arm itself, limits and borders, with the hand in view of
    two cameras. turn (7,) [rad]: at most from start to end.
    """
    least = 0.5 * float(np.linalg.norm(turn) / np.linalg.norm(TURN))
    pairs, radii = model.self_pairs(), model.sphere_set.radii
    for _ in range(400):
        start = CENTRE + rng.uniform(-1, 1, 7) * SPREAD
        end = start + rng.uniform(-1, 1, 7) * turn
        begin, stop = rng.uniform(0.5, 0.8), rng.uniform(2.3, 2.8)
        motion = Motion(times=np.array([0.0, begin, stop]), waypoints=np.array([start, start, end]))
        q = positions_of(motion, samples()[::2])
        if np.any(q < model.lower + 0.05) or np.any(q > model.upper - 0.05) or np.linalg.norm(end - start) < least:
            continue
        centers = model.sphere_centers_batch(q)
        gaps = np.linalg.norm(centers[:, pairs[:, 0]] - centers[:, pairs[:, 1]], axis=2)
        if np.min(gaps - radii[pairs].sum(axis=1)) < 0.04 or not BOX.contains(centers[:, model.moving_spheres]).all():
            continue
        hands = [model.frame_pose(position, "hand")[:3, 3] for position in q[::3]]
        if min(sum(_shows(camera, hand) for camera in cameras) for hand in hands) < 2:
            continue
        if arm.clearances([table()], samples()[::2], q).min() > 0.08:
            return motion
    raise RuntimeError("no motion found")


def draw_cameras(rng: np.random.Generator, width: int = WIDTH) -> tuple[Camera, ...]:
    """Three cameras about the table at random places; width [px] of their images."""
    focal, height = 1.0 * width, 3 * width // 4
    k = Intrinsics(
        fx=focal, fy=focal, cx=(width - 1) / 2 + 0.7, cy=(height - 1) / 2 - 0.6, width=width, height=height
    )
    places = (((1.15, -0.15, 0.95), 0.12), ((0.15, -0.90, 0.85), 0.12), ((0.20, 0.95, 0.90), 0.12))
    return tuple(
        Camera(
            name=f"cam{index}",
            intrinsics=k,
            T_world_camera=look_at(
                np.array(eye) + rng.uniform(-spread, spread, 3),
                np.array([0.32, 0.0, 0.27]) + rng.uniform(-0.05, 0.05, 3),
            ),
            is_training=True,
        )
        for index, (eye, spread) in enumerate(places)
    )


def wrist_camera(width: int = WIDTH) -> Camera:
    """A camera next to the hand, looking past the fingers; its T_world_camera is T_hand_camera."""
    height = 3 * width // 4
    k = Intrinsics(
        fx=0.8 * width, fy=0.8 * width, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height
    )
    T_hand_camera = look_at(np.array([0.09, 0.0, -0.02]), np.array([0.02, 0.0, 0.35]))
    return Camera(name="wrist", intrinsics=k, T_world_camera=T_hand_camera, is_training=True)


def draw_things(rng: np.random.Generator, motion: Motion, arm: TrueArm) -> Made:
    """The table and up to three things on it, each at least 9 cm from the arm at all times."""
    stamps = samples()[::2]
    q, found = positions_of(motion, stamps), [table()]
    wanted = 1 + int(rng.integers(0, 4))
    for _ in range(30):
        if len(found) == wanted:
            break
        name = f"thing{len(found)}"
        thing = standing(name, *draw_shape(rng), rng.uniform((0.25, -0.6), (0.9, 0.6)), rng)
        if np.linalg.norm(thing.T_world_shape[:2, 3]) > 0.3 and arm.clearances([thing], stamps, q).min() > 0.09:
            found.append(thing)
    return tuple(found)


def draw_shape(rng: np.random.Generator) -> tuple[str, tuple[float, ...]]:
    """Kind and size [m] of a household thing."""
    kind = ("box", "cylinder", "sphere")[int(rng.integers(3))]
    if kind == "box":
        return kind, tuple(float(v) for v in rng.uniform((0.06, 0.06, 0.10), (0.18, 0.18, 0.40)))
    if kind == "cylinder":
        return kind, (float(rng.uniform(0.03, 0.07)), float(rng.uniform(0.12, 0.45)))
    return kind, (float(rng.uniform(0.04, 0.09)),)


def standing(name: str, kind: str, size: tuple[float, ...], place: Float64, rng: np.random.Generator) -> Primitive:
    """A solid on the table at (2,) [m]."""
    height = {"box": size[-1] / 2, "cylinder": size[-1] / 2, "sphere": size[0]}.get(kind, size[-1] / 2 + size[0])
    return _solid(name, kind, size, np.array([place[0], place[1], height]), rng)


def floating(
    name: str,
    kind: str,
    size: tuple[float, ...],
    place: Float64,
    rng: np.random.Generator,
    z_axis: Float64 | None = None,
) -> Primitive:
    """A solid with its middle at (3,) [m] and its own z axis along (3,)."""
    solid = _solid(name, kind, size, place, rng)
    if z_axis is None:
        return solid
    return replace(solid, T_world_shape=pose_at(place, frame_along(z_axis)))


def shifted(solid: Primitive, place: Float64) -> Primitive:
    """The same solid with its middle at (3,) [m]."""
    return replace(solid, T_world_shape=pose_at(place, solid.T_world_shape[:3, :3]))


def moving(solid: Primitive, seconds: Sequence[float], offsets: Float64) -> Primitive:
    """The solid on a track: at its place plus offsets (K, 3) [m] at times (K,) [s]."""
    poses = np.repeat(solid.T_world_shape[None], len(seconds), axis=0)
    poses[:, :3, 3] += offsets
    stamps = np.array([at_s(second) for second in seconds], dtype=np.int64)
    return replace(solid, T_world_shape=poses[0], track=Track(stamp_ns=stamps, T_world_shape=poses))


def during(solid: Primitive, from_s: float | None, to_s: float | None) -> Primitive:
    """The solid, there only from a time to another [s]."""
    return replace(
        solid, from_ns=ALWAYS[0] if from_s is None else at_s(from_s), to_ns=ALWAYS[1] if to_s is None else at_s(to_s)
    )


def placed(
    rng: np.random.Generator,
    make: Make,
    motion: Motion,
    arm: TrueArm,
    cameras: Sequence[Camera],
    *,
    clearance: float,
    second: float,
    towards: Float64 | None = None,
    from_link: float = 0.5,
) -> Made | None:
    """The target at `clearance` [m] from the recorded arm, in view of two cameras or all; None without such a place.

    Bisection moves the target towards a point of the arm at time `second` [s], from a horizontal direction or from
    the point `towards` (3,). from_link: share of the arm, from its base, that is never that point.
    """
    stamps = samples()
    q = positions_of(motion, stamps)
    marks = arm.marks(positions_of(motion, np.array([at_s(second)])))[0]

    def least(place: Float64) -> float:
        return float(arm.clearances(make(place), stamps, q).min())

    for _ in range(12):
        mark = marks[int(rng.integers(int(from_link * len(marks)), len(marks)))]  # of the forearm and the hand
        angle = rng.uniform(-np.pi, np.pi)
        away = np.array([np.cos(angle), np.sin(angle), 0.0])
        if towards is not None:
            away = (towards - mark) / np.linalg.norm(towards - mark)
        near, far = mark, mark + 0.02 * away
        while least(far) < clearance and np.linalg.norm(far - mark) < 0.6:
            near, far = far, far + 0.06 * away
        if least(far) < clearance or least(near) >= clearance or not _is_in_reach(far, cameras):
            continue
        for _ in range(8):
            middle = (near + far) / 2
            near, far = (middle, far) if least(middle) < clearance else (near, middle)
        return make(near if clearance < 0 else far)
    return None


def _is_in_reach(place: Float64, cameras: Sequence[Camera]) -> bool:
    """True if a place is in the workspace, in view, and not on the arm's base."""
    if not BOX.contains(place) or np.linalg.norm(place[:2]) < 0.2 or place[0] < -0.1:
        return False
    return sum(_shows(camera, place) for camera in cameras) >= min(2, len(cameras))


def _shows(camera: Camera, place: Float64) -> bool:
    """True if a point (3,) is before a camera, at least three pixels inside its image."""
    point = transform_points(invert_transform(camera.T_world_camera), place[None])[0]
    pixel = project(camera.intrinsics, point)
    inside = np.all((pixel > 3) & (pixel < [camera.intrinsics.width - 4, camera.intrinsics.height - 4]))
    return bool(point[2] > 0.1 and inside)


def _solid(name: str, kind: str, size: tuple[float, ...], place: Float64, rng: np.random.Generator) -> Primitive:
    yaw = rng.uniform(0, np.pi)
    T = pose_at(place, None if name == "table" else turn_about_z(yaw))
    dark, bright = PALETTE[list(PALETTE)[int(rng.integers(len(PALETTE)))]]
    texture = Texture(
        pattern=("stripes", "checks")[int(rng.integers(2))],
        feature=float(rng.uniform(0.05, 0.09)),
        dark=dark,
        bright=bright,
        seed=int(rng.integers(1000)),
    )
    return Primitive(name=name, kind=kind, size=size, T_world_shape=T, texture=texture)
