"""What was known of the space beside the arm, against a plain reference."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import NEAR_EVERY_NS, NEAR_LATTICE, NEAR_MOVED
from splatctrl_cli.control.near_space import NearSpace, Seen
from splatctrl_cli.records import Float64, UInt8
from splatctrl_cli.voxels import EvidenceClass
from tests.control.fakes import PlanarArm, ThinArm
from tests.reference.intervals import points_beside

SECOND = 1_000_000_000
FIRST, LATER = np.array([0.0, 0.0]), np.array([1.2, 0.6])


def seen_by(classes: EvidenceClass | Callable[[Float64], UInt8], stamp_ns: int = 0) -> Seen:
    """All that is free was seen at a stamp."""

    def look(points: Float64) -> tuple[NDArray[np.int64], UInt8]:
        found = classes(points) if callable(classes) else np.full(len(points), np.uint8(classes))
        return np.where(found == EvidenceClass.FREE, np.int64(stamp_ns), np.int64(-1)), found

    return Seen(look=look)


def half_seen(points: Float64) -> UInt8:
    """Free above the plane z = 0, below hidden by the arm."""
    return np.where(points[:, 2] >= 0, np.uint8(EvidenceClass.FREE), np.uint8(EvidenceClass.HIDDEN_BY_ARM))


def off_the_tip(arm: PlanarArm, away: float) -> Float64:
    """A place so far [m] above the last sphere."""
    return arm.sphere_centers(LATER)[-1] + np.array([0.0, 0.0, arm.sphere_set.radii[-1] + away])


def stamped(stamps_at: Callable[[int], NDArray[np.int64]]) -> Seen:
    """All is free, and was seen at these stamps."""
    return Seen(look=lambda points: (stamps_at(len(points)), np.zeros(len(points), np.uint8)))


def above(height: float) -> Seen:
    """A sheet seen from above alone: what is under it was never seen."""
    free, never = np.uint8(EvidenceClass.FREE), np.uint8(EvidenceClass.OUT_OF_VIEW)
    return seen_by(lambda points: np.where(points[:, 2] > height, free, never))


@cache
def near_points(margin: float) -> list[tuple[Float64, float, int]]:
    return list(points_beside(PlanarArm(), LATER, margin, NEAR_LATTICE))


def test_the_account_is_that_of_the_reference() -> None:
    hidden = EvidenceClass.HIDDEN_BY_ARM
    found = NearSpace(PlanarArm(), 0.03).look(0, LATER, seen_by(half_seen))
    beside, wide = near_points(0.03), near_points(0.03 + NEAR_LATTICE / 2)
    assert len(beside) > 100
    assert found.shares.sum() == pytest.approx(1.0)
    assert found.shares[hidden] == pytest.approx(np.mean([point[2] < 0 for point, *_ in beside]))
    assert found.assumed == pytest.approx(np.mean([point[2] < 0 for point, *_ in wide]))
    nearest = min(gap for point, gap, _ in wide if point[2] < 0)
    assert found.nearest[hidden] == pytest.approx(max(nearest - NEAR_LATTICE / 2, 0.0))
    assert found.places[hidden][2] < 0 and found.nearest[EvidenceClass.CONTRADICTED] == np.inf


@pytest.mark.parametrize(
    "kind", [EvidenceClass.CONTRADICTED, EvidenceClass.UNANSWERED, EvidenceClass.OUTSIDE, EvidenceClass.SWEPT]
)
def test_every_point_has_one_class_at_its_own_distance(kind: EvidenceClass) -> None:
    """One voxel of a class, off the tip of the arm."""
    arm, free = PlanarArm(), np.uint8(EvidenceClass.FREE)
    place = NEAR_LATTICE * np.round(off_the_tip(arm, 0.04) / NEAR_LATTICE)
    gap = min(np.linalg.norm(place - arm.sphere_centers(LATER), axis=1) - arm.sphere_set.radii) - NEAR_LATTICE / 2
    seen = seen_by(lambda points: np.where(np.linalg.norm(points - place, axis=1) < 1e-6, np.uint8(kind), free))
    found = NearSpace(arm, 0.06).look(0, LATER, seen)
    assert (found.nearest[kind], found.places[kind].tolist()) == (pytest.approx(gap), place.tolist())
    assert found.shares[kind] > 0 and found.assumed > 0


@pytest.mark.parametrize(
    ("stamp", "kind", "assumed"), [(SECOND, EvidenceClass.FREE, 0.0), (2 * SECOND, EvidenceClass.STALE, 1.0)]
)
def test_what_was_seen_too_long_ago_is_stale(stamp: int, kind: EvidenceClass, assumed: float) -> None:
    found = NearSpace(PlanarArm(), 0.03, max_age=1.0).look(stamp, LATER, seen_by(EvidenceClass.FREE))
    assert (found.shares[kind], found.assumed, found.age) == (1.0, assumed, pytest.approx(stamp / SECOND))


def test_seen_after_the_state_is_ahead_of_it() -> None:
    space = NearSpace(PlanarArm(), 0.03)
    found = space.look(0, LATER, seen_by(EvidenceClass.FREE, SECOND))
    assert (found.ahead, found.age) == (pytest.approx(1.0), pytest.approx(-1.0))
    never = space.look(0, LATER, seen_by(EvidenceClass.OUT_OF_VIEW))
    assert np.isnan(never.ahead) and np.isnan(never.age)
    some = space.look(0, LATER, stamped(lambda num: np.where(np.arange(num) % 9 > 0, 0, SECOND)))
    assert some.ahead == pytest.approx(1.0)


@pytest.mark.parametrize("turn", [0.05, 0.2])
def test_on_the_way_no_sphere_moves_by_a_centimetre_from_one_posture_to_the_next(turn: float) -> None:
    arm, last = PlanarArm(), FIRST + np.array([turn, 0.0])
    way = NearSpace(arm, 0.03).postures_between(FIRST, last)
    centers = np.array([arm.sphere_centers(q) for q in (FIRST, *way, last)])
    moved = np.linalg.norm(np.diff(centers, axis=0), axis=2).max(axis=1)
    assert moved.max() <= NEAR_MOVED and moved.min() > 0.8 * moved.max()
    assert len(way) == np.ceil(0.9 * turn / 0.01) - 1


@pytest.mark.parametrize(("old", "age"), [(0.2, 1.0), (0.3, 9.0)])
def test_the_age_is_that_of_three_in_four(old: float, age: float) -> None:
    """A few points that nobody looks at any more say nothing, more of them do."""
    seen = stamped(lambda num: np.where(np.arange(num) < round(old * num), SECOND, 9 * SECOND))
    assert NearSpace(PlanarArm(), 0.03).look(10 * SECOND, FIRST, seen).age == pytest.approx(age)


def test_the_space_beside_a_link_with_triangles_is_that_beside_its_surface() -> None:
    """Its spheres stick out by 2 cm: the margin counts from the surface, also inside of another of its spheres."""
    asked: list[Float64] = []
    arm = ThinArm()
    arm.sphere_set.radii[:] = [0.06, 0.04, 0.04, 0.14, 0.14]  # the two of `fore` hold each other's surface

    def remembered(points: Float64) -> UInt8:
        asked.append(points)
        return np.zeros(len(points), np.uint8)

    NearSpace(arm, 0.03).look(0, LATER, seen_by(remembered))
    gaps = np.linalg.norm(asked[0][:, None] - arm.sphere_centers(LATER), axis=2) - arm.sphere_set.radii
    nearest = (gaps[:, 1:] + 0.02).min(axis=1)
    assert nearest.min() > -1e-3 and nearest.max() < 0.031 + NEAR_LATTICE / 2 and len(nearest) > 500
    assert gaps[:, 0].min() > 0  # outside of the base


def test_states_are_thinned_by_time_across_blocks() -> None:
    space, stamps = NearSpace(PlanarArm(), 0.03), np.arange(0, 800, 40, dtype=np.int64) * 1_000_000  # 25 Hz
    assert NEAR_EVERY_NS == 200_000_000
    still = np.repeat(PlanarArm().sphere_centers(LATER)[None], len(stamps), axis=0)
    assert space.choose(stamps[:12], still[:12]) == {0: True, 5: True, 10: True}
    assert space.choose(stamps[12:], still[12:]) == {3: True}  # the state at 600 ms
    slow = np.array([10 * SECOND, 11 * SECOND])
    assert list(space.choose(slow, still[:2])) == [0, 1]  # all of them are looked at


def test_no_sphere_of_a_fast_arm_moves_a_centimetre_between_two_looks() -> None:
    arm, space = PlanarArm(), NearSpace(PlanarArm(), 0.03)
    joints = FIRST + np.linspace(0.0, 0.1, 50)[:, None]  # in 100 ms
    centers, stamps = arm.sphere_centers_batch(joints), np.arange(50, dtype=np.int64) * 2_000_000
    first, rest = (space.choose(stamps[part], centers[part]) for part in (slice(20), slice(20, None)))
    assert [at for at, is_timed in first.items() if is_timed] == [0] and not any(rest.values())
    chosen = [*first, *(20 + at for at in rest)]
    assert 3 < len(chosen) < 50
    step = np.linalg.norm(np.diff(centers, axis=0), axis=2).max()
    for begin, end in pairwise([*chosen, 50]):
        moved = np.linalg.norm(centers[begin : end + 1] - centers[begin], axis=2).max(axis=1)
        assert moved[: end - begin].max() < NEAR_MOVED and moved.max() < NEAR_MOVED + step


def test_a_robot_within_its_own_base_has_nothing_beside_it() -> None:
    arm = PlanarArm()
    arm.sphere_set.radii[0] = 5.0  # the base swallows all of the arm
    found = NearSpace(arm, 0.03).look(0, FIRST, seen_by(half_seen))
    assert not found.shares.any() and np.isnan(found.age) and (found.assumed, found.blind_to_surface) == (0.0, np.inf)


def test_a_lost_edge_is_as_near_as_its_ball() -> None:
    arm, edge = PlanarArm(), EvidenceClass.DEPTH_EDGE
    near, large = off_the_tip(arm, 0.02), off_the_tip(arm, 0.03)
    edges = np.array([[*near, 0.001], [*large, 0.015]])
    found = NearSpace(arm, 0.03).look(0, LATER, replace(seen_by(half_seen), edges=edges))
    assert (found.nearest[edge], found.places[edge].tolist()) == (pytest.approx(0.015), large.tolist())
    thin = NearSpace(ThinArm(), 0.05).look(0, LATER, replace(seen_by(half_seen), edges=edges))
    assert thin.nearest[edge] == pytest.approx(0.035)
    nothing = NearSpace(arm, 0.03).look(0, LATER, seen_by(half_seen))
    assert nothing.nearest[edge] == np.inf and np.isnan(nothing.places[edge]).all()


@pytest.mark.parametrize("away", [0.02, 0.05, 0.09])
def test_an_unseen_pocket_anywhere_within_a_wide_margin_is_found(away: float) -> None:
    arm, free, hidden = PlanarArm(), np.uint8(EvidenceClass.FREE), np.uint8(EvidenceClass.HIDDEN_BY_THING)
    place = off_the_tip(arm, away)
    seen = seen_by(lambda points: np.where(np.linalg.norm(points - place, axis=1) < 0.02, hidden, free))
    found = NearSpace(arm, 0.1).look(0, LATER, seen, lambda points: np.full(len(points), 0.01))
    assert found.unseen_path == pytest.approx(0.01 + away, abs=0.02)
    assert np.linalg.norm(found.unseen_path_place - place) < 0.02


@pytest.mark.parametrize("height", [-0.3, 0.0, 0.05, 0.4])
def test_the_least_path_over_unseen_space_is_as_long_as_by_the_reference(height: float) -> None:
    found = NearSpace(PlanarArm(), 0.03).look(0, LATER, above(height), lambda points: height - points[:, 2] + 1e-9)
    never = [height - point[2] + gap for point, gap, *_ in near_points(0.03) if point[2] <= height]
    assert found.unseen_path == (pytest.approx(min(never), abs=1e-8) if never else np.inf)
    assert bool(never) == (height > -0.3)


@pytest.mark.parametrize(("height", "is_blind"), [(0.0, False), (0.2, True)])
def test_a_sphere_that_comes_to_the_unseen_alone_has_a_distance_of_its_own(height: float, is_blind: bool) -> None:
    """Under the sheet: of 4 cm spheres most of the space about them, or all."""
    found = NearSpace(PlanarArm(), 0.03).look(0, LATER, above(height), lambda points: height - points[:, 2] + 1e-9)
    assert np.isfinite(found.unseen_path) and np.isfinite(found.blind_to_surface) == is_blind
    assert not is_blind or found.blind_to_surface == pytest.approx(height - found.blind_place[2], abs=1e-8)


def test_what_lies_within_a_surface_of_the_map_is_surface_and_a_map_without_an_answer_hides_nothing() -> None:
    space, seen = NearSpace(PlanarArm(), 0.03), seen_by(half_seen)
    found = space.look(0, LATER, seen, lambda points: points[:, 2])
    assert found.shares[EvidenceClass.HIDDEN_BY_ARM] == 0.0 and found.shares[EvidenceClass.SURFACE] > 0.3
    nowhere = space.look(SECOND, LATER, seen, lambda points: np.full(len(points), np.nan))
    assert found.unseen_path == nowhere.unseen_path == np.inf
