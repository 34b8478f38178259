"""The exact clearance of the arm's true surface, also between the samples of a motion.

The arm is the capsules and blocks of its body; the scene is primitives. All are convex. Thus the signed distance to a
primitive is a convex function along a capsule's axis and over a block.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import BASE, Block, Capsule
from splatctrl_cli.simulate.primitives import Primitive, closest_point, signed_distance
from tools.hunt.body import Body

GOLDEN = (np.sqrt(5) - 1) / 2
NUM_GOLDEN = 22  # steps: 3e-5 of a capsule's length
NUM_PROJECTIONS = 60  # between a block and a primitive
FIRST_STEP, SHRINK = 0.01, 0.88  # [m] into a primitive, and the share of it that is left after each
STEP_NS = 20_000_000  # between the first samples of a motion
TOLERANCE = 2e-4  # [m] by which a minimum between two samples may be missed

Stamps = NDArray[np.int64]
Positions = Callable[[Stamps], Float64]


class TrueArm:
    """The surfaces of the moving links of `model`'s arm.

    tool: a further capsule on the hand, which no model includes. body: visual shapes, by default the collision
    shapes.
    """

    def __init__(self, model: RobotModel, tool: Capsule | None = None, body: Body | None = None) -> None:
        shapes = [(link, shape) for link, shape in (body or Body()).solids if link != BASE]
        if tool is not None:
            shapes.append(("hand", tool))
        capsules = [(link, shape) for link, shape in shapes if isinstance(shape, Capsule)]
        self._blocks = [(link, shape) for link, shape in shapes if isinstance(shape, Block)]
        points = [(link, end) for link, shape in capsules for end in (shape.start, shape.end)]
        points += [
            (link, np.array(shape.middle) + offset)
            for link, shape in self._blocks
            for offset in (np.zeros(3), *np.eye(3))
        ]
        marks = SphereSet(
            links=tuple(link for link, _ in points),
            centers=np.array([point for _, point in points], dtype=np.float64),
            radii=np.full(len(points), 1e-3),
        )
        self._marks = RobotModel.from_urdf(model.urdf.path, marks, T_world_base=model.T_world_base)
        self._num_capsules = len(capsules)
        self._radii = np.array([shape.radius for _, shape in capsules])

    def marks(self, q: Float64) -> Float64:
        """Points (T, M, 3) [m], world, that place every shape at joint positions q (T, J)."""
        return self._marks.sphere_centers_batch(q)

    def clearances(self, primitives: Sequence[Primitive], stamps: Stamps, q: Float64) -> Float64:
        """Signed distance (T,) [m] of the surface from the primitives present at each stamp. It is negative in
        contact, and then no deeper than the truth.
        """
        marks = self.marks(q)
        ends = marks[:, : 2 * self._num_capsules].reshape(len(q), self._num_capsules, 2, 3)
        frames = marks[:, 2 * self._num_capsules :].reshape(len(q), len(self._blocks), 4, 3)
        found = np.full(len(q), np.inf)
        for primitive in primitives:
            there = np.flatnonzero([primitive.is_present(int(stamp)) for stamp in stamps])
            if len(there) == 0:
                continue
            T_shape_world = _into(primitive, stamps[there])
            local = _moved(T_shape_world, ends[there])
            found[there] = np.minimum(found[there], self._of_capsules(primitive, local, found[there]))
            for index, (_, block) in enumerate(self._blocks):
                corner = _moved(T_shape_world, frames[there, index])
                found[there] = np.minimum(found[there], _of_block(primitive, corner, block, found[there]))
        return np.asarray(found)

    def _of_capsules(self, primitive: Primitive, ends: Float64, bound: Float64) -> Float64:
        """Least clearance (T,) of capsules with axes `ends` (T, C, 2, 3) in the primitive's frame, exact below
        `bound` (T,).
        """
        at_rest = _centred(primitive)
        half = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2) / 2
        middle = _signed(at_rest, ends.mean(axis=2)) - self._radii
        t, c = np.nonzero(middle - half < np.minimum(bound, middle.min(axis=1))[:, None])
        start, along = ends[t, c, 0], ends[t, c, 1] - ends[t, c, 0]
        low, high = np.zeros(len(t)), np.ones(len(t))
        for _ in range(NUM_GOLDEN):
            a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
            at_a, at_b = (_signed(at_rest, start + s[:, None] * along) for s in (a, b))
            high, low = np.where(at_a < at_b, b, high), np.where(at_a < at_b, low, a)
        best = np.full(len(ends), np.inf)
        for s in (np.zeros(len(t)), (low + high) / 2, np.ones(len(t))):
            np.minimum.at(best, t, _signed(at_rest, start + s[:, None] * along) - self._radii[c])
        return np.asarray(np.minimum(best, middle.min(axis=1)))


def least_clearance(
    arm: TrueArm, primitives: Sequence[Primitive], positions: Positions, first_ns: int, last_ns: int
) -> tuple[float, int]:
    """The least clearance [m] of a motion and its time [ns]; intervals that may contain less are halved.

    positions: joint positions (T, J) at stamps (T,). Between two samples, clearance is at least their mean minus half
    of the distance that arm and scene moved.
    """
    knots = [knot for p in primitives if p.track is not None for knot in p.track.stamp_ns.tolist()]
    edges = [edge for p in primitives for edge in (p.from_ns, p.to_ns - 1)]
    turns = [stamp for stamp in (*knots, *edges) if first_ns <= stamp <= last_ns]
    stamps = np.unique([*np.arange(first_ns, last_ns, STEP_NS), last_ns, *turns]).astype(np.int64)
    values, moved = _sampled(arm, primitives, positions, stamps)
    while True:
        least = (values[:-1] + values[1:] - _travel(moved)) / 2
        wide = (least < values.min() - TOLERANCE) & (np.diff(stamps) > 100_000)
        if not wide.any():
            best = int(np.argmin(values))
            return float(values[best]), int(stamps[best])
        between = (stamps[:-1][wide] + stamps[1:][wide]) // 2
        new_values, new_moved = _sampled(arm, primitives, positions, between)
        order = np.argsort(np.concatenate([stamps, between]), kind="stable")
        stamps = np.concatenate([stamps, between])[order]
        values = np.concatenate([values, new_values])[order]
        moved = tuple(np.concatenate([old, new])[order] for old, new in zip(moved, new_moved, strict=True))


def _sampled(
    arm: TrueArm, primitives: Sequence[Primitive], positions: Positions, stamps: Stamps
) -> tuple[Float64, tuple[Float64, ...]]:
    """Clearances (T,), and points (T, M, 3) of the arm and of each solid that moves, world."""
    q = positions(stamps)
    tracked = [primitive for primitive in primitives if primitive.track is not None]
    poses = (np.array([p.at(int(stamp)).T_world_shape for stamp in stamps]) for p in tracked)
    ends = [
        np.concatenate(
            [T[:, None, :3, 3], T[:, None, :3, 3] + p.bounding_radius * T[:, :3, :3].transpose(0, 2, 1)], 1
        )
        for p, T in zip(tracked, poses, strict=True)
    ]
    return arm.clearances(primitives, stamps, q), (arm.marks(q), *ends)


def _travel(moved: tuple[Float64, ...]) -> Float64:
    """Largest approach (T - 1,) [m] of arm and scene between samples, for solids that move straight."""
    steps = [np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1) for points in moved]
    return np.asarray(steps[0] + (np.max(steps[1:], axis=0) if len(steps) > 1 else 0.0))


def _of_block(primitive: Primitive, corners: Float64, block: Block, bound: Float64) -> Float64:
    """Least clearance (T,) of a block whose middle and axes are `corners` (T, 4, 3), in the primitive's frame.

    Projects in turns on the primitive and on the block. If they meet, it descends the signed distance with shrinking
    steps.
    """
    at_rest, half = _centred(primitive), np.array(block.size) / 2
    out = _signed(at_rest, corners[:, 0]) - float(half.min())
    near = np.flatnonzero(out - float(np.linalg.norm(half)) < bound)
    if len(near) == 0:
        return out
    middle, axes = corners[near, 0], corners[near, 1:] - corners[near, :1]

    def clipped(points: Float64) -> Float64:
        inside = np.einsum("tac,tc->ta", axes, points - middle)
        return np.asarray(middle + np.einsum("ta,tac->tc", np.clip(inside, -half, half), axes))

    point = clipped(np.zeros_like(middle))  # nearest to the primitive's middle
    best = np.full(len(near), np.inf)
    for number in range(NUM_PROJECTIONS):
        distance, surface = closest_point(at_rest, point)
        best = np.minimum(best, distance)
        outward = (point - surface) / np.where(distance == 0, np.inf, distance)[:, None]
        step = np.maximum(distance, FIRST_STEP * SHRINK**number)
        point = clipped(point - step[:, None] * outward)
    out[near] = np.minimum(best, _signed(at_rest, point))
    return np.asarray(out)


def _into(primitive: Primitive, stamps: Stamps) -> Float64:
    """T_shape_world (T, 4, 4)."""
    if primitive.track is None:
        return np.broadcast_to(invert_transform(primitive.T_world_shape), (len(stamps), 4, 4))
    return np.array([invert_transform(primitive.at(int(stamp)).T_world_shape) for stamp in stamps])


def _moved(T: Float64, points: Float64) -> Float64:
    """points (T, ..., 3) by transforms T (T, 4, 4)."""
    flat = points.reshape(len(T), -1, 3)
    return np.asarray(np.einsum("tij,tpj->tpi", T[:, :3, :3], flat) + T[:, None, :3, 3]).reshape(points.shape)


def _centred(primitive: Primitive) -> Primitive:
    return Primitive(
        name=primitive.name,
        kind=primitive.kind,
        size=primitive.size,
        T_world_shape=np.eye(4),
        texture=primitive.texture,
    )


def _signed(primitive: Primitive, points: Float64) -> Float64:
    """Signed distances (...,) of points (..., 3)."""
    return signed_distance(primitive, points.reshape(-1, 3)).reshape(points.shape[:-1])


def interpolated(stamps: Stamps, position: Float64) -> Positions:
    """Joint positions between the states (T, J) of a motion, straight in joint space."""

    def at(asked: Stamps) -> Float64:
        return np.stack([np.interp(asked - stamps[0], stamps - stamps[0], column) for column in position.T], axis=1)

    return at
