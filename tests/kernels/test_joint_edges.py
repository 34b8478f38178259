"""The compiled edge check: the same shares as the one in NumPy, to the bit for any number of threads."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.solids import Ball, Cuboid, Rod, Solid, Solids
from splatctrl_cli.config.fixed import STILL_ROW
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.planner.configuration_clearance import ROUNDING, Clearance, check_edges, check_sampled_edges
from splatctrl_cli.planner.planned import resample
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel

CONTACT = 1e-4
KINDS = ("ball", "box", "cylinder", "capsule")


@pytest.fixture(scope="module")
def arm(plain_arm: Path) -> RobotModel:
    folder = plain_arm / "tabletop"
    return RobotModel.from_urdf(folder / "robot.urdf", folder / "robot_spheres.yaml")


def solid(kind: str, random: np.random.Generator) -> Solid:
    turn = random.normal(size=4)
    out = random.normal(size=3)
    place = random.uniform(0.5, 1.0) * out / np.linalg.norm(out)  # away from the base
    T = transform_from(place, turn / np.linalg.norm(turn))
    if kind == "ball":
        return Ball(center=T[:3, 3], radius=float(random.uniform(0.01, 0.2)))
    if kind == "box":
        return Cuboid(size=random.uniform(0.01, 0.4, 3), T_world_shape=T)
    radius, length = random.uniform(0.01, 0.1), random.uniform(0.05, 0.5)
    return Rod(radius=float(radius), length=float(length), T_world_shape=T, is_round=kind == "capsule")


def room_of(arm: RobotModel, kinds: tuple[str, ...], seed: int) -> tuple[Clearance, Float64, Float64]:
    """An arm among solids, and edges from postures that are free."""
    random = np.random.default_rng(seed)
    room = Clearance.of(arm, Solids(solids=[solid(k, random) for k in kinds for _ in range(3)]), margin=0.005)
    q = random.uniform(arm.lower, arm.upper, (600, 7))
    q = q[room.at(q) > 1e-3][:25]
    assert len(q) > 5
    way = random.normal(size=q.shape)
    way *= random.uniform(0.1, 1.5, (len(q), 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    return room, q, np.clip(q + way, arm.lower, arm.upper)


@pytest.mark.parametrize("only_whole", [True, False])
@pytest.mark.parametrize("kinds", [(kind,) for kind in KINDS] + [KINDS, ()])
def test_the_kernel_proves_what_numpy_proves(arm: RobotModel, kinds: tuple[str, ...], only_whole: bool) -> None:
    num_free = num_part = 0
    for seed in range(4):
        room, start, end = room_of(arm, kinds, seed)
        assert room.compiled is not None
        found = check_edges(room, start, end, contact=CONTACT, give_up=0.05, only_whole=only_whole)
        plain = check_sampled_edges(room, start, end, contact=CONTACT, give_up=0.05, only_whole=only_whole)
        np.testing.assert_allclose(found.free_share, plain.free_share, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(found.is_free, plain.is_free)
        assert len(start) <= found.num_checks <= plain.num_checks
        num_free += int(found.is_free.sum())
        num_part += int(np.sum((found.free_share > 0) & ~found.is_free))
    assert num_free > 10 and num_part == 0 if only_whole else num_part > 3


def test_no_edge_that_the_kernel_accepts_collides_at_dense_samples(arm: RobotModel) -> None:
    for seed in range(3):
        room, start, end = room_of(arm, KINDS, 100 + seed)
        share = check_edges(room, start, end, contact=CONTACT, only_whole=False).free_share
        for a, b, free in zip(start, end, share, strict=True):
            assert np.all(room.at(resample(np.array([a, a + free * (b - a)]), 5e-3)) >= 0)


def test_an_edge_of_no_length_is_free_or_not_as_its_posture_is(arm: RobotModel) -> None:
    room, start, _ = room_of(arm, KINDS, 3)
    assert np.all(check_edges(room, start, start, contact=CONTACT).is_free)
    inside = Clearance.of(arm, Solids(solids=[Ball(center=arm.sphere_centers(start[0])[-1], radius=0.05)]))
    assert check_edges(inside, start[:1], start[:1], contact=CONTACT).free_share == 0


def test_shares_do_not_depend_on_threads(arm: RobotModel) -> None:
    room, start, end = room_of(arm, KINDS, 5)
    asked = {"contact": CONTACT, "give_up": 0.05, "rounding": ROUNDING, "still": STILL_ROW}
    one, *others = (room.compiled.advance(start, end, **asked, only_whole=False, threads=num) for num in (1, 2, 7))
    for other in others:
        np.testing.assert_array_equal(other, one)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (lambda good: {"taken": good.taken[1:]}, "expected taken"),
        (lambda good: {"pairs": good.pairs + 1000}, "pairs: expected spheres that are there"),
        (lambda good: {"boxes": good.boxes[:, :14].copy()}, "solids: expected a row of numbers"),
        (lambda good: {"groups": good.groups + 1000}, "groups: expected parts that are there"),
        (
            lambda good: {name: getattr(good, name)[:-1] for name in ("groups", "group_taken", "group_levers")},
            "groups: expected every row in one of them",
        ),
        (lambda good: {"contact": 0.0}, "contact and still above 0"),
        (lambda good: {"num_joints": 6}, "expected start and end"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(arm: RobotModel, changed: Callable[[Any], Any], words: str) -> None:
    room, start, end = room_of(arm, KINDS, 6)
    changes = changed(room.compiled)
    asked = {"contact": changes.pop("contact", CONTACT), "give_up": 0.1, "rounding": 0.0, "still": STILL_ROW}
    end = end[:, : changes.pop("num_joints", 7)]
    with pytest.raises(ValueError, match=words):
        replace(room.compiled, **changes).advance(start, end, **asked, only_whole=True)
