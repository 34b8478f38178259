"""Primitives: distances with known answers, and against each other (rays, surface points, dense sampling)."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import look_at, pose_at, transform_points
from splatctrl_cli.records import Float64
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.primitives import (
    ALWAYS,
    Primitive,
    Texture,
    Track,
    closest_point,
    hit,
    normals,
    signed_distance,
)
from splatctrl_cli.simulate.recording import START_NS
from splatctrl_cli.simulate.truth import distance_along, distance_to

PLAIN = Texture(pattern="noise", feature=0.1, dark=(0, 0, 0), bright=(1, 1, 1))
TILTED = look_at([0.3, -0.2, 0.5], [1.0, 0.4, 0.1])
SIZES = {"box": (0.2, 0.4, 0.6), "cylinder": (0.2, 0.6), "sphere": (0.3,), "capsule": (0.2, 0.3)}
KINDS = sorted(SIZES)


def solid(kind: str, T_world_shape: Float64 | None = None) -> Primitive:
    pose = np.eye(4) if T_world_shape is None else T_world_shape
    return Primitive(name=kind, kind=kind, size=SIZES[kind], T_world_shape=pose, texture=PLAIN)


def surface_samples(kind: str, rng: np.random.Generator, count: int = 100_000) -> Float64:
    """Points on the surface, in the solid's own frame."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if kind == "sphere":
        return direction * 0.3
    if kind == "box":
        p = rng.uniform(-1, 1, (count, 3))
        axis = rng.integers(0, 3, count)
        p[np.arange(count), axis] = np.sign(p[np.arange(count), axis])
        return p * np.array([0.1, 0.2, 0.3])
    if kind == "capsule":
        is_side = rng.uniform(size=count) < 0.5
        axis = np.where(is_side, rng.uniform(-0.15, 0.15, count), np.copysign(0.15, direction[:, 2]))
        direction[is_side, 2] = 0.0
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return 0.2 * direction + axis[:, None] * np.array([0, 0, 1])
    angle = rng.uniform(0, 2 * np.pi, count)
    is_side = rng.uniform(size=count) < 0.7
    rho = np.where(is_side, 0.2, 0.2 * np.sqrt(rng.uniform(size=count)))
    z = np.where(is_side, rng.uniform(-0.3, 0.3, count), rng.choice([-0.3, 0.3], count))
    return np.column_stack([rho * np.cos(angle), rho * np.sin(angle), z])


@pytest.mark.parametrize(
    ("kind", "point", "distance"),
    [
        ("box", (0.4, 0, 0), 0.3),
        ("box", (0.4, 0.6, 0), 0.5),
        ("box", (0.05, 0, 0), -0.05),
        ("box", (0.0, 0.19, 0), -0.01),
        ("cylinder", (0.5, 0, 0), 0.3),
        ("cylinder", (0, 0, 0.5), 0.2),
        ("cylinder", (0.5, 0, 0.7), 0.5),
        ("cylinder", (0, 0, 0), -0.2),
        ("cylinder", (0, 0.05, -0.28), -0.02),
        ("sphere", (0, 0.5, 0), 0.2),
        ("capsule", (0.5, 0, 0.1), 0.3),
        ("capsule", (0, 0, 0.5), 0.15),
        ("capsule", (0.3, 0, 0.55), 0.3),
        ("capsule", (0, 0, 0.1), -0.2),
        ("capsule", (0, 0, 0.25), -0.1),
        ("sphere", (0, 0, 0), -0.3),
    ],
)
def test_distance_to_a_solid_at_the_origin_is_known(kind: str, point: tuple[float, ...], distance: float) -> None:
    assert signed_distance(solid(kind), np.array([point]))[0] == pytest.approx(distance, abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_distance_agrees_with_dense_samples_of_the_surface(kind: str) -> None:
    rng = np.random.default_rng(1)
    surface = surface_samples(kind, rng)
    points = rng.uniform(-0.6, 0.6, (40, 3))
    nearest = np.array([np.min(np.linalg.norm(surface - p, axis=1)) for p in points])
    np.testing.assert_allclose(np.abs(signed_distance(solid(kind), points)), nearest, atol=3e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_the_closest_point_lies_on_the_surface_at_the_distance_which_moves_with_the_solid(kind: str) -> None:
    local = np.random.default_rng(2).uniform(-0.7, 0.7, (500, 3))
    points = transform_points(TILTED, local)
    distance, surface = closest_point(solid(kind, TILTED), points)
    np.testing.assert_allclose(distance, signed_distance(solid(kind), local), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - surface, axis=1), np.abs(distance), atol=1e-12)
    np.testing.assert_allclose(signed_distance(solid(kind, TILTED), surface), 0, atol=1e-12)
    assert (distance < 0).any() and (distance > 0).any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_ray_stops_where_the_distance_first_becomes_zero(kind: str) -> None:
    shape = solid(kind, TILTED)
    rng = np.random.default_rng(4)
    origin = TILTED[:3, 3] + np.array([1.0, 0.4, -0.3])
    directions = TILTED[:3, 3] + rng.uniform(-0.4, 0.4, (400, 3)) - origin
    t = hit(shape, origin, directions)
    is_hit = np.isfinite(t)
    assert 50 < is_hit.sum() < 400
    ends = origin + t[is_hit, None] * directions[is_hit]
    np.testing.assert_allclose(signed_distance(shape, ends), 0, atol=1e-9)
    before = origin + (t[is_hit, None] * np.linspace(0.01, 0.99, 50)[:, None, None]) * directions[is_hit]
    assert signed_distance(shape, before.reshape(-1, 3)).min() > 0
    along = origin + np.linspace(0, 2, 400)[:, None, None] * directions[~is_hit]
    assert signed_distance(shape, along.reshape(-1, 3)).min() > -1e-3
    assert np.isinf(hit(shape, origin, -directions)).all(), "behind the camera"


@pytest.mark.parametrize("kind", KINDS)
def test_normals_are_the_gradient_of_the_distance(kind: str) -> None:
    points = surface_samples(kind, np.random.default_rng(5), 300)
    step = 1e-6
    gradient = np.stack(
        [
            (signed_distance(solid(kind), points + step * e) - signed_distance(solid(kind), points - step * e))
            / (2 * step)
            for e in np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(normals(solid(kind), points), gradient, atol=2e-3)


def test_a_solid_is_present_from_its_first_stamp_to_before_its_last() -> None:
    shape = Primitive(
        name="a", kind="sphere", size=(1.0,), T_world_shape=np.eye(4), texture=PLAIN, from_ns=10, to_ns=20
    )
    assert [shape.is_present(t) for t in (9, 10, 19, 20)] == [False, True, True, False]


def track() -> Track:
    poses = np.stack([np.eye(4), TILTED, look_at([0.1, 0.5, 0.4], [0.0, 0.0, 0.0])])
    return Track(stamp_ns=np.array([100, 200, 400], dtype=np.int64), T_world_shape=poses)


def test_a_track_moves_straight_and_turns_evenly_between_its_poses() -> None:
    moves = track()
    turn = Slerp(moves.stamp_ns, Rotation.from_matrix(moves.T_world_shape[:, :3, :3]))
    for stamp in (100, 130, 200, 275, 400):
        T = moves.at(stamp)
        np.testing.assert_allclose(T[:3, :3], turn(stamp).as_matrix(), atol=1e-12)
        expected = [np.interp(stamp, moves.stamp_ns, moves.T_world_shape[:, axis, 3]) for axis in range(3)]
        np.testing.assert_allclose(T[:3, 3], expected, atol=1e-12)
    np.testing.assert_array_equal(moves.at(0), moves.T_world_shape[0])
    np.testing.assert_array_equal(moves.at(10**9), moves.T_world_shape[2])


def test_a_solid_that_moves_is_where_its_track_is() -> None:
    moving = Primitive(
        name="a", kind="capsule", size=SIZES["capsule"], T_world_shape=np.eye(4), texture=PLAIN, track=track()
    )
    points = np.random.default_rng(7).uniform(-0.7, 0.7, (100, 3))
    placed = moving.at(275)
    assert placed.track is None
    np.testing.assert_array_equal(
        signed_distance(placed, points), signed_distance(solid("capsule", track().at(275)), points)
    )


def test_a_track_without_order_is_refused() -> None:
    with pytest.raises(InputError, match="stamps that increase"):
        Track(stamp_ns=np.array([5, 5], dtype=np.int64), T_world_shape=np.stack([np.eye(4)] * 2))
    with pytest.raises(InputError, match="a pose for every stamp, got 1 for 2"):
        Track(stamp_ns=np.array([5, 6], dtype=np.int64), T_world_shape=np.eye(4)[None])


def test_distance_along_a_motion_is_that_at_each_of_its_stamps() -> None:
    stamps = START_NS + np.linspace(0, 7e9, 15).astype(np.int64)
    points = np.random.default_rng(0).uniform(-0.5, 1.0, (15, 40, 3))
    visitor = tabletop.visitor(int(stamps[5]), int(stamps[9]), (0.4, 0.2, 0.06))
    poses = np.stack([visitor.T_world_shape, pose_at([0.8, 0.0, 0.1])])
    moved = replace(visitor, from_ns=ALWAYS[0], track=Track(stamp_ns=stamps[[3, 12]], T_world_shape=poses))
    primitives = [*tabletop.objects(), visitor, moved]
    expected = [distance_to(primitives, *at) for at in zip(points, stamps.tolist(), strict=True)]
    np.testing.assert_array_equal(distance_along(primitives, points, stamps), expected)
    assert np.isinf(distance_along([visitor], points, stamps)[[0, -1]]).all()
