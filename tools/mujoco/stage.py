"""Draw a recording: a room with a table, a moving robot, and objects at a chosen clearance from it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import mujoco
import numpy as np

from tools.mujoco.cell import COLLIDES, Cell, Lens
from tools.mujoco.images import Camera
from tools.mujoco.poses import Float64, look_at, pose, turn_rpy
from tools.mujoco.robots import Robot
from tools.mujoco.solids import Solid, Track, fixed
from tools.mujoco.truth import Body, World, clearance_of

DURATION_S = 4.0
SAMPLES = np.linspace(0.0, DURATION_S, 21)  # [s] at which things are placed
SPEED_SHARE = 0.6  # of a joint's velocity limit, at most
SELF_CLEARANCE = 0.015  # [m]
TABLE_CLEARANCE = 0.10  # [m] of links that reach out
CLUTTER_CLEARANCE = 0.15  # [m]
ROOM = (
    ("floor", (3.0, 3.0, 0.01), (0.4, 0.0, -0.76), (0.40, 0.42, 0.40)),
    ("wall_x", (0.02, 3.0, 1.6), (-1.3, 0.0, 0.8), (0.62, 0.60, 0.52)),
    ("wall_left", (3.0, 0.02, 1.6), (0.4, 1.9, 0.8), (0.50, 0.58, 0.62)),
    ("wall_right", (3.0, 0.02, 1.6), (0.4, -1.9, 0.8), (0.60, 0.52, 0.50)),
    ("table", (0.60, 0.75, 0.02), (0.33, 0.0, -0.02), (0.58, 0.44, 0.30)),
)
PLACES = {
    "camera_left": ((1.05, 1.05, 0.90), (0.28, 0.0, 0.34)),
    "camera_right": ((1.05, -1.05, 0.95), (0.28, 0.0, 0.34)),
    "camera_back": ((-0.95, 0.30, 1.30), (0.35, 0.0, 0.28)),
    "camera_front": ((1.70, 0.05, 1.00), (0.28, 0.0, 0.34)),
}
Make = Callable[[Float64], Sequence[Solid]]  # solids about a place (3,) [m]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Waypoints (W, J) [rad], reached at rest at times (W,) [s], joined by minimum-jerk segments."""

    times: Float64
    waypoints: Float64

    def at(self, times: Float64) -> tuple[Float64, Float64]:
        """Positions and velocities (T, J); at rest before the first and after the last waypoint."""
        inside = np.clip(times, self.times[0], self.times[-1])
        segment = np.clip(np.searchsorted(self.times, inside, side="right") - 1, 0, len(self.times) - 2)
        span = np.diff(self.times)[segment]
        s = ((inside - self.times[segment]) / span)[:, None]
        step = np.diff(self.waypoints, axis=0)[segment]
        q = self.waypoints[segment] + step * s**3 * (10 - 15 * s + 6 * s**2)
        return q, step * 30 * s**2 * (1 - s) ** 2 / span[:, None]


@dataclass(kw_only=True)
class Stage:
    """A recording while it is drawn."""

    rng: np.random.Generator
    robot: Robot
    motion: Motion
    solids: list[Solid] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    pose_errors: dict[str, Float64] = field(default_factory=dict)  # T_true_logged (4, 4) by camera
    _seen: tuple[int, dict[str, Body]] | None = None
    _poses: dict[bytes, dict[str, Float64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._cell = Cell(self.robot, (), ())

    @classmethod
    def draw(cls, rng: np.random.Generator, robot: Robot, *, is_at_rest: bool = False) -> "Stage":
        """A room, a motion without contact with the table or the robot itself, and three cameras."""
        stage = cls(rng=rng, robot=robot, motion=_drawn_motion(rng, robot, is_at_rest=is_at_rest))
        stage.solids += room()
        stage.use_cameras(("camera_left", "camera_right", "camera_back"))
        return stage

    def use_cameras(self, names: Sequence[str]) -> None:
        """Cameras of `PLACES`, drawn a little beside them."""
        self.cameras = [draw_camera(self.rng, name) for name in names]

    def tip(self, second: float) -> Float64:
        """T_world_tip (4, 4) at a time [s]."""
        return np.asarray(self._surfaces(np.array([second]))[1][self.robot.description.tip][0])

    def marks(self, second: float) -> Float64:
        """Points (M, 3) [m] on the moving links' visual surfaces at a time [s]."""
        seen, poses = self._surfaces(np.array([second]))
        return np.concatenate(
            [b.triangles[::7].mean(axis=1) @ poses[k][0, :3, :3].T + poses[k][0, :3, 3] for k, b in seen.items()]
        )

    def least(self, solids: Sequence[Solid], times: Float64 = SAMPLES) -> float:
        """The least clearance [m] from solids of the visible robot and the solids fixed to it."""
        seen, poses = self._surfaces(times)
        return float(clearance_of(seen, poses, solids, times).least.min())

    def _surfaces(self, times: Float64) -> tuple[dict[str, Body], dict[str, Float64]]:
        """Visible bodies of the moving links, and poses (T, 4, 4) of all links at times (T,) [s]."""
        fixed_here = sum(solid.link is not None for solid in self.solids)
        if self._seen is None or self._seen[0] != fixed_here:
            self._seen = (fixed_here, World(robot=self.robot, solids=tuple(self.solids)).seen())
            self._poses.clear()
        key = times.tobytes()
        if key not in self._poses:
            self._poses[key] = self._cell.link_poses(self.motion.at(times)[0])
        return self._seen[1], self._poses[key]

    def put(
        self,
        make: Make,
        clearance: float,
        *,
        second: float | None = None,
        aside: Float64 | None = None,
        at_start: float = -1.0,
    ) -> None:
        """Add solids where the recorded motion's least clearance from them is `clearance` [m], by bisection.

        The solids move towards a point of the robot at time `second` [s], from the direction `aside` (3,) or a random
        horizontal one. at_start [m]: their least clearance at the start. Raises NoPlaceError if no place was found.
        """
        for _ in range(20):
            marks = self.marks(float(self.rng.uniform(0.3, 3.7)) if second is None else second)
            outer = marks[np.hypot(marks[:, 0], marks[:, 1]) > 0.25]
            if len(outer) == 0:
                continue
            mark = outer[int(self.rng.integers(len(outer)))]
            angle = self.rng.uniform(-np.pi, np.pi)
            away = np.array([np.cos(angle), np.sin(angle), 0.0]) if aside is None else aside
            near, far = 0.0, 0.03
            while far < 0.7 and self.least(make(mark + far * away)) < clearance:
                near, far = far, far + 0.04
            place = mark + far * away
            if far >= 0.7 or self.least(make(mark + near * away)) >= clearance or not _is_on_table(place):
                continue
            for _ in range(11):
                middle = (near + far) / 2
                near, far = (middle, far) if self.least(make(mark + middle * away)) < clearance else (near, middle)
            found = make(mark + (near if clearance < 0 else far) * away)
            is_alone = all(
                gap(one, other) > 0.0 for one in found for other in self.solids[len(ROOM) :] if not other.link
            )
            if is_alone and self.least(found, np.zeros(1)) > at_start:
                self.solids += found
                return
        raise NoPlaceError(f"{self.robot.name}: expected a place at {1e3 * clearance:.0f} mm, found none")

    def add_clutter(self, most: int = 5) -> None:
        """Things on the table that the robot never comes near."""
        wanted = int(self.rng.integers(2, most + 1))
        count = 0
        for _ in range(60):
            if count == wanted:
                return
            x, y = self.rng.uniform((-0.1, -0.68), (0.85, 0.68))
            thing = draw_thing(self.rng, f"clutter{count}")(np.array([x, y, 0.0]))
            others = [other for other in self.solids[len(ROOM) :] if not other.link]
            clear = all(gap(thing[0], other) > 0.02 for other in others)
            if np.hypot(x, y) > 0.28 and clear and self.least(thing) > CLUTTER_CLEARANCE:
                self.solids += thing
                count += 1


class NoPlaceError(Exception):
    """No place was found for a solid; the recording is drawn anew."""


def room() -> list[Solid]:
    """Floor, walls and the table whose top is at z = 0."""
    return [
        Solid(name=name, kind="box", size=size, track=fixed(pose(place)), rgb=rgb) for name, size, place, rgb in ROOM
    ]


def draw_camera(rng: np.random.Generator, name: str, phase: float = 0.0) -> Camera:
    """A camera near its place of `PLACES`, with the lens of a D435's colour imager."""
    eye, target = (np.array(place) for place in PLACES[name])
    return Camera(
        name=name,
        lens=draw_lens(rng),
        T_parent_camera=look_at(eye + rng.uniform(-0.06, 0.06, 3), target + rng.uniform(-0.05, 0.05, 3)),
        phase=phase,
    )


def draw_lens(rng: np.random.Generator) -> Lens:
    """Draw the lens of a D435's colour imager at 640x480."""
    f = float(rng.uniform(600, 616))
    return Lens(
        fx=f,
        fy=f * float(rng.uniform(0.999, 1.001)),
        cx=float(319.5 + rng.uniform(-7, 6)),
        cy=float(239.5 + rng.uniform(-6, 6)),
    )


def draw_thing(rng: np.random.Generator, name: str, height: float | None = None) -> Make:
    """An object on the table below a place; `height` [m]: how far it rises above the place."""
    kind = ("box", "can", "bottle", "ball")[int(rng.integers(4 if height is None else 3))]
    rgb = tuple(float(v) for v in rng.uniform(0.25, 0.85, 3))
    wide, turn = float(rng.uniform(0.03, 0.05)), turn_rpy((0.0, 0.0, float(rng.uniform(0, np.pi))))
    deep, tall = float(rng.uniform(0.03, 0.06)), float(rng.uniform(0.08, 0.22))

    def make(place: Float64) -> Sequence[Solid]:
        top = tall if height is None else max(float(place[2]) + height, 0.06)
        base = pose((place[0], place[1], 0.0), turn)
        middle = pose((place[0], place[1], top / 2), turn)
        common = {"name": name, "rgb": rgb}
        if kind == "box":
            return [Solid(kind="box", size=(wide, deep, top / 2), track=fixed(middle), **common)]  # type: ignore[arg-type]
        if kind == "can":
            return [Solid(kind="cylinder", size=(wide, top / 2), track=fixed(middle), **common)]  # type: ignore[arg-type]
        if kind == "ball":
            up = pose((place[0], place[1], wide))
            return [Solid(kind="ball", size=(wide,), track=fixed(up), **common)]  # type: ignore[arg-type]
        return [Solid(kind="lathe", profile=bottle(wide, top), track=fixed(base), **common)]  # type: ignore[arg-type]

    return make


def bottle(radius: float, height: float) -> Float64:
    """Profile (P, 2) [m] of a bottle with a neck."""
    r, h = radius, height
    return np.array(
        [[0, 0], [r, 0], [r, 0.6 * h], [0.85 * r, 0.7 * h], [0.4 * r, 0.8 * h], [0.35 * r, h], [0, h]],
        dtype=np.float64,
    )


def travelling(solids: Sequence[Solid], times: Sequence[float], offsets: Float64) -> list[Solid]:
    """Solids that move to offsets (K, 3) [m] from their places at times (K,) [s]."""
    out = []
    for solid in solids:
        poses = np.repeat(solid.track.poses[:1], len(times), axis=0)
        poses[:, :3, 3] += offsets
        out.append(replace(solid, track=Track(times=np.array(times, np.float64), poses=poses)))
    return out


def gap(one: Solid, other: Solid) -> float:
    """Horizontal gap [m] between circles around two solids at their first poses."""
    a, b = one.track.poses[0][:3, 3], other.track.poses[0][:3, 3]
    return float(np.linalg.norm((a - b)[:2])) - _girth(one) - _girth(other)


def _girth(solid: Solid) -> float:
    """Radius [m] about its vertical axis, as it stands upright."""
    if solid.kind == "box":
        return float(np.hypot(solid.size[0], solid.size[1]))
    return float(solid.profile[:, 0].max()) if solid.kind == "lathe" else solid.size[0]


def _is_on_table(place: Float64) -> bool:
    return bool(-0.15 < place[0] < 0.92 and abs(place[1]) < 0.72 and np.hypot(place[0], place[1]) > 0.22)


def _drawn_motion(rng: np.random.Generator, robot: Robot, *, is_at_rest: bool) -> Motion:
    low, high = np.array(robot.description.low), np.array(robot.description.high)
    limit = np.array([joint.velocity for joint in robot.driven])
    cell, table = Cell(robot, room(), ()), room()[-1]
    world = World(robot=robot, solids=())
    seen = {link: body for link, body in world.seen().items() if link not in _near_base(robot)}
    for _ in range(300):
        start = rng.uniform(low, high)
        end = start if is_at_rest else np.clip(start + rng.uniform(-1, 1, len(low)) * 0.8 * (high - low), low, high)
        motion = Motion(times=np.array([0.4, float(rng.uniform(3.0, 3.6))]), waypoints=np.array([start, end]))
        times = SAMPLES[::4] if is_at_rest else SAMPLES
        q, velocity = motion.at(times)
        if np.any(np.abs(velocity) > SPEED_SHARE * limit):
            continue
        poses = cell.link_poses(q)
        moves = np.linalg.norm(poses[robot.description.tip][-1, :3, 3] - poses[robot.description.tip][0, :3, 3])
        if not is_at_rest and moves < 0.15:
            continue
        if clearance_of(seen, poses, [table], times).least.min() < TABLE_CLEARANCE:
            continue
        if all(_self_clearance(cell, position) > SELF_CLEARANCE for position in q[:: 1 if is_at_rest else 4]):
            return motion
    raise NoPlaceError(f"{robot.name}: expected a motion, found none")


def _near_base(robot: Robot) -> set[str]:
    """The fixed links and the first two that move, which are always near the table."""
    moving = [joint.child for joint in robot.joints if joint.kind != "fixed"]
    return set(robot.fixed_links) | set(moving[:2])


def _self_clearance(cell: Cell, q: Float64) -> float:
    """The least distance [m] between collision hulls of links with at least two links between them."""
    cell.place(q, 0.0)
    depth = {cell.robot.root: 0}
    for joint in cell.robot.joints:
        depth[joint.child] = depth[joint.parent] + (joint.kind == "revolute")
    geoms = {link: cell.geoms_of([link], COLLIDES) for link in cell.links if cell.robot.collision.get(link)}
    return min(
        [
            mujoco.mj_geomDistance(cell.model, cell.data, int(g), int(h), 0.1, None)
            for (a, mine), (b, others) in product(geoms.items(), repeat=2)
            if depth[a] + 3 <= depth[b]
            for g, h in product(mine, others)
        ],
        default=1.0,
    )
