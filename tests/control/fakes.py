"""A planar two-link arm in plain NumPy and two distance fields, all with known answers."""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import BallDistance
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.replay import ReplayTrace
from splatctrl_cli.control.step import ControlStep, QpIkController
from splatctrl_cli.kernels.chain import Chain
from splatctrl_cli.records import Bool, Float64, SphereSet
from splatctrl_cli.robot.model import RobotModel


class PlanarArm:
    """Two unit-ish links in the plane z = 0, about z at the base; spheres along the links and one on the base."""

    chain: Chain | None = None

    def __init__(self, lengths: tuple[float, float] = (0.5, 0.4), radius: float = 0.04) -> None:
        self.lengths = lengths
        self.joint_names: Sequence[str] = ("shoulder", "elbow")
        self.lower, self.upper = np.array([-2.9, -2.6]), np.array([2.9, 2.6])
        self.velocity_limit = np.array([1.5, 1.5])
        along = [0.25, 0.5, 0.2, 0.4]
        self.sphere_set = SphereSet(
            links=("base", "upper", "upper", "fore", "fore"),
            centers=np.array([[0.0, 0, 0]] + [[x, 0, 0] for x in along]),
            radii=np.array([0.06] + [radius] * 4),
        )
        self.moving_spheres: Bool = np.array([False, True, True, True, True])
        self.sphere_deficit: Float64 = np.full(5, np.nan)
        self.base_position: Float64 = np.zeros(3)
        self.middle: Float64 = np.zeros(2)
        self.link_distances: Mapping[str, Callable[[Float64, Bool | None], Float64]] = {}
        self.pairs = np.array([[0, 3], [0, 4]])

    def sphere_centers(self, q: Float64) -> Float64:
        return self.sphere_centers_batch(q[None])[0]

    def lever_arms(self) -> Float64:
        x = self.sphere_set.centers[:, 0]
        is_fore = np.array([link == "fore" for link in self.sphere_set.links])
        return np.stack([np.where(is_fore, self.lengths[0] + x, x), np.where(is_fore, x, 0.0)], axis=1)

    def sphere_centers_batch(self, q: Float64) -> Float64:
        elbow = np.array([0.0, 0.0, 0.0, self.lengths[0], self.lengths[0]])
        turn, bent = q[:, :1], q.sum(axis=1)[:, None]
        along = self.sphere_set.centers[:, 0]
        upper, fore = np.where(elbow > 0, elbow, along), np.where(elbow > 0, along, 0.0)
        x = upper * np.cos(turn) + fore * np.cos(bent)
        y = upper * np.sin(turn) + fore * np.sin(bent)
        return np.stack([x, y, np.zeros_like(x)], axis=2)

    def spheres_at(self, q: Float64) -> tuple[Float64, Float64]:
        return self.sphere_centers(q), self.sphere_jacobians(q)

    def sphere_jacobians(self, q: Float64) -> Float64:
        centers, elbow = self.sphere_centers(q), self.lengths[0] * _unit(q[0])
        J = np.zeros((len(centers), 3, 2))
        J[1:, :, 0] = [_turned(c) for c in centers[1:]]
        J[3:, :, 1] = [_turned(c - elbow) for c in centers[3:]]
        return J

    def frame_pose(self, q: Float64, frame: str) -> Float64:
        T = np.eye(4)
        c, s = np.cos(q.sum()), np.sin(q.sum())
        T[:2, :2] = [[c, -s], [s, c]]
        T[:3, 3] = self.lengths[0] * _unit(q[0]) + self.lengths[1] * _unit(q.sum())
        return T

    def frame_jacobian(self, q: Float64, frame: str) -> Float64:
        tip, elbow = self.frame_pose(q, frame)[:3, 3], self.lengths[0] * _unit(q[0])
        J = np.zeros((6, 2))
        J[:3, 0], J[:3, 1], J[5] = _turned(tip), _turned(tip - elbow), 1.0
        return J

    def self_pairs(self) -> "np.ndarray":
        return self.pairs

    @property
    def self_allowance(self) -> Float64:
        return np.zeros(len(self.pairs))

    def reach(self) -> float:
        return sum(self.lengths)


class Balls:
    """Exact distance to balls: ``min_i |x - c_i| - r_i``, and its gradient."""

    def __init__(self, centers: Sequence[Sequence[float]], radii: Sequence[float]) -> None:
        self.centers, self.radii = np.array(centers, dtype=float), np.array(radii, dtype=float)
        self.num_queries = 0

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        self.num_queries += 1
        offset = points[:, None, :] - self.centers[None]
        length = np.linalg.norm(offset, axis=2)
        nearest = np.argmin(length - self.radii, axis=1)
        rows = np.arange(len(points))
        distance = length[rows, nearest]
        return distance - self.radii[nearest], offset[rows, nearest] / np.maximum(distance, 1e-12)[:, None]


class Plane:
    """Distance to the half space ``n . x <= offset``, scaled: the gradient is `scale` long, not 1."""

    def __init__(self, normal: Sequence[float], offset: float, scale: float = 1.0) -> None:
        self.normal, self.offset, self.scale = np.array(normal, dtype=float), offset, scale

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        distance = self.scale * (points @ self.normal - self.offset)
        return distance, np.broadcast_to(self.scale * self.normal, points.shape)


class Nowhere:
    """A field without a distance anywhere."""

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        return np.full(len(points), np.nan), np.zeros_like(points)


def far_away() -> Balls:
    """A field with nothing near the arm."""
    return Balls([[50.0, 0, 0]], [1.0])


def sample_arm(plain_arm: Path) -> RobotModel:
    """The seven joints of the sample data."""
    folder = plain_arm / "tabletop"
    return RobotModel.from_urdf(folder / "robot.urdf", folder / "robot_spheres.yaml")


def steps_towards(
    controller: QpIkController, q: Float64, T_goal: Float64, num: int
) -> tuple[list[ControlStep], list[Float64]]:
    """So many steps from rest, and the postures before and after each."""
    steps: list[ControlStep] = []
    postures, velocity = [q], np.zeros(len(q))
    for _ in range(num):
        steps.append(controller.step(postures[-1], T_goal, last_velocity=velocity))
        velocity = steps[-1].velocity
        postures.append(postures[-1] + ControlConfig().period * velocity)
    return steps, postures


class ThinArm(PlanarArm):
    """Its moving links' own surfaces are balls 2 cm smaller than its spheres."""

    def __init__(self) -> None:
        super().__init__()
        self.link_distances = {link: partial(self._distance, link) for link in ("upper", "fore")}

    def frame_pose(self, q: Float64, frame: str) -> Float64:
        if frame not in self.link_distances:
            return super().frame_pose(q, frame)
        turn = _unit(q[0] if frame == "upper" else q.sum())
        T = np.eye(4)
        T[:3, :2] = np.stack([turn, _turned(turn)], axis=1)
        T[:3, 3] = 0.0 if frame == "upper" else self.lengths[0] * _unit(q[0])
        return T

    def _distance(self, link: str, points: Float64, outside: Bool | None = None) -> Float64:
        own = np.array(self.sphere_set.links) == link
        away = np.linalg.norm(points[:, None] - self.sphere_set.centers[own], axis=2)
        return np.asarray((away - self.sphere_set.radii[own] + 0.02).min(axis=1))

    def surface_gaps(
        self, positions: Float64, centers: Float64, radii: Float64, links: Collection[str] | None = None
    ) -> dict[str, Float64]:
        of = np.array(self.sphere_set.links)
        away = np.linalg.norm(self.sphere_centers(positions[0])[:, None] - centers, axis=2)
        gap = away - self.sphere_set.radii[:, None] + 0.02 - radii
        return {link: np.array([gap[of == link].min()]) for link in links or dict.fromkeys(of.tolist())}


def scene_of(centers: list[list[float]], radii: list[float]) -> BallDistance:
    balls = Balls(centers, radii)

    def of_points(points: Float64) -> Float64:
        return balls.query(points)[0]

    return BallDistance(of_points=of_points, centers=np.array(centers), radii=np.array(radii))


def _unit(angle: float) -> Float64:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _turned(vector: Float64) -> Float64:
    return np.array([-vector[1], vector[0], 0.0])


def num_on_rung(trace: ReplayTrace, rung: Rung) -> int:
    """How many steps came about on a rung of the ladder."""
    return sum(step.rung is rung for step in trace.steps)
