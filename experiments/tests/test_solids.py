import numpy as np
import pytest
from scipy.spatial import cKDTree

from experiments.solids import Ball, Cuboid, Rod, Solid, Solids
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.simulate.primitives import Primitive, Texture, signed_distance


def placed(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    return transform_from(rng.normal(scale=0.3, size=3), quat / np.linalg.norm(quat))


PLAIN = Texture(pattern="noise", feature=0.1, dark=(0, 0, 0), bright=(1, 1, 1))
BALL = Ball(center=np.array([0.3, -0.2, 0.1]), radius=0.15)
BOX = Cuboid(size=np.array([0.3, 0.5, 0.2]), T_world_shape=placed(1))
CYLINDER = Rod(radius=0.1, length=0.4, T_world_shape=placed(2))
CAPSULE = Rod(radius=0.1, length=0.4, T_world_shape=placed(3), is_round=True)


def points(num: int = 400, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.8, 0.8, (num, 3))


def surface_samples(solid: Solid) -> np.ndarray:
    """Points on a solid's surface, close together."""
    if isinstance(solid, Cuboid):
        u = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 61)] * 2), axis=-1).reshape(-1, 2)
        local = np.concatenate([np.insert(u, axis, s, axis=1) for axis in range(3) for s in (-0.5, 0.5)]) * solid.size
    else:
        assert isinstance(solid, Rod)
        angle, half = np.linspace(0, 2 * np.pi, 121), solid.length / 2
        rings = [(1.0, z) for z in np.linspace(-half, half, 121)]  # shares of the radius, and heights
        for share in np.linspace(0, 1, 61):
            bulge = solid.radius * np.sqrt(1 - share**2) if solid.is_round else 0.0
            rings += [(share, side * (half + bulge)) for side in (-1, 1)]
        share, z = np.repeat(rings, 121, axis=0).T
        ring = solid.radius * share * np.tile([np.cos(angle), np.sin(angle)], len(rings))
        local = np.stack([*ring, z], axis=1)
    return local @ solid.T_world_shape[:3, :3].T + solid.T_world_shape[:3, 3]


@pytest.mark.parametrize("solid", [BOX, CYLINDER, CAPSULE], ids=["box", "cylinder", "capsule"])
def test_distances_are_those_to_the_nearest_of_many_surface_points(solid: Solid) -> None:
    nearest = cKDTree(surface_samples(solid)).query(points())[0]
    distance = np.abs(Solids(solids=[solid]).distance(points()))
    assert np.all(distance <= nearest + 1e-12)
    np.testing.assert_allclose(distance, nearest, atol=2e-3)  # the samples' spacing, at its worst near them


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
def test_distances_are_those_of_the_simulator(kind: str) -> None:
    solid, size, T = {
        "box": (BOX, tuple(BOX.size), BOX.T_world_shape),
        "cylinder": (CYLINDER, (CYLINDER.radius, CYLINDER.length), CYLINDER.T_world_shape),
        "sphere": (BALL, (BALL.radius,), transform_from(BALL.center, [0, 0, 0, 1])),
    }[kind]
    same = Primitive(name="same", kind=kind, size=size, T_world_shape=T, texture=PLAIN)
    np.testing.assert_allclose(Solids(solids=[solid]).distance(points()), signed_distance(same, points()), atol=1e-12)


def test_several_solids_are_as_near_as_the_nearest() -> None:
    solids = [BALL, BOX, CYLINDER, CAPSULE]
    each = np.min([Solids(solids=[solid]).distance(points()) for solid in solids], axis=0)
    np.testing.assert_array_equal(Solids(solids=solids).distance(points()), each)
    assert np.all(Solids(solids=[]).distance(points()) == np.inf)


def test_no_distance_changes_faster_than_the_point_moves() -> None:
    a, b = points(seed=1), points(seed=1) + np.random.default_rng(2).normal(scale=0.05, size=(400, 3))
    scene = Solids(solids=[BALL, BOX, CYLINDER, CAPSULE])
    assert np.all(np.abs(scene.distance(a) - scene.distance(b)) <= np.linalg.norm(a - b, axis=1) + 1e-12)


def test_the_gradient_is_that_of_the_distance() -> None:
    scene, q = Solids(solids=[BALL, CYLINDER]), points(50)
    distance, gradient = scene.query(q)
    np.testing.assert_array_equal(distance, scene.distance(q))
    way = np.random.default_rng(5).normal(size=(50, 3)) * 1e-5
    change = scene.distance(q + way) - scene.distance(q - way)
    np.testing.assert_allclose(change, 2 * np.einsum("qk,qk->q", gradient, way), atol=1e-8)


def test_a_solid_without_size_is_refused() -> None:
    with pytest.raises(InputError, match=r"solid 1: expected sizes above 0 m, got \(0.0,\)"):
        Solids(solids=[BOX, Ball(center=np.zeros(3), radius=0.0)])
