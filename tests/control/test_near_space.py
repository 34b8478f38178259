"""What was known just outside of the arm, against a plain reference."""

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import NEAR_EVERY_NS, NEAR_MOVED
from splatctrl_cli.control.near_space import NearSpace, Seen
from splatctrl_cli.records import Float64
from tests.control.fakes import PlanarArm, ThinArm
from tests.reference.intervals import beyond, blind_share, hidden, near_figures

SECOND = 1_000_000_000
FIRST, LATER = np.array([0.0, 0.0]), np.array([1.2, 0.6])


def half_seen(points: Float64) -> NDArray[np.int64]:
    """Above the plane z = 0 seen at 1 to 2 s by their x, below never."""
    stamps = ((1.5 + 0.5 * points[:, 0]) * SECOND).astype(np.int64)
    return np.where(points[:, 2] >= 0, stamps, -1)


def test_figures_are_those_of_the_reference() -> None:
    arm, space = PlanarArm(), NearSpace(PlanarArm(), 0.03)
    first = space.look(0, FIRST, Seen(last_ns=half_seen))
    assert np.isnan(first.unseen)  # the arm was there from the start
    found = space.look(5 * SECOND, LATER, Seen(last_ns=half_seen))
    unseen, age, num = near_figures(arm, LATER, FIRST, 0.03, half_seen, 5 * SECOND)
    assert num > 60
    assert (found.unseen, found.age) == (pytest.approx(unseen), pytest.approx(age))
    assert 0.2 < found.unseen < 0.5 and 3 < found.age < 4


@pytest.mark.parametrize(("stamp", "unseen"), [(-1, 1.0), (0, 0.0), (SECOND, 0.0)])
def test_a_stamp_of_zero_is_seen_and_minus_one_never(stamp: int, unseen: float) -> None:
    space = NearSpace(PlanarArm(), 0.03)
    space.look(0, FIRST, Seen(last_ns=lambda points: np.zeros(len(points), np.int64)))
    found = space.look(2 * SECOND, LATER, Seen(last_ns=lambda points: np.full(len(points), stamp)))
    assert found.unseen == unseen
    assert np.isnan(found.age) if stamp < 0 else found.age == pytest.approx(2 - stamp / SECOND)


@pytest.mark.parametrize(("old", "age"), [(0.2, 1.0), (0.3, 9.0)])
def test_the_age_is_that_of_three_in_four(old: float, age: float) -> None:
    """A few points that nobody looks at any more say nothing, more of them do."""
    space = NearSpace(PlanarArm(), 0.03)

    def seen(points: Float64) -> NDArray[np.int64]:
        stamps = np.full(len(points), 9 * SECOND, np.int64)
        stamps[: round(old * len(points))] = SECOND
        return stamps

    assert space.look(10 * SECOND, FIRST, Seen(last_ns=seen)).age == pytest.approx(age)


def test_points_that_are_not_outside_of_the_arm_are_not_asked_for() -> None:
    arm = PlanarArm()
    asked: list[Float64] = []
    space = NearSpace(arm, 0.03)

    def remember(points: Float64) -> NDArray[np.int64]:
        asked.append(points)
        return np.zeros(len(points), np.int64)

    space.look(0, LATER, Seen(last_ns=remember))
    (points,) = asked
    gap = np.linalg.norm(points[:, None] - arm.sphere_centers(LATER), axis=2) - arm.sphere_set.radii
    assert gap.min() > 0.01 and (gap.min(axis=1) < 0.03 + 1e-12).all()


def test_the_shell_of_a_link_with_triangles_is_that_of_its_surface() -> None:
    """Its spheres stick out by 2 cm: the margin counts from the surface, also inside of another of its spheres."""
    asked: list[Float64] = []
    arm = ThinArm()
    arm.sphere_set.radii[:] = [0.06, 0.04, 0.04, 0.14, 0.14]  # the two of `fore` hold each other's surface

    def remember(points: Float64) -> NDArray[np.int64]:
        asked.append(points)
        return np.zeros(len(points), np.int64)

    NearSpace(arm, 0.03).look(0, LATER, Seen(last_ns=remember))
    gaps = np.linalg.norm(asked[0][:, None] - arm.sphere_centers(LATER), axis=2) - arm.sphere_set.radii + 0.02
    nearest = gaps[:, 1:].min(axis=1)
    assert np.abs(nearest - 0.03).max() < 0.0105 and len(nearest) > 60  # 1 cm where another part is as near
    assert (np.abs(nearest - 0.03) < 1e-3).mean() > 0.9


def test_distances_are_those_of_the_surface_within_the_margin() -> None:
    arm, thin = PlanarArm(), ThinArm()
    out = np.array([0.0, 0.0, arm.sphere_set.radii[-1]])
    near, far = (arm.sphere_centers(LATER)[-1] + out + [0.0, 0.0, up] for up in (0.005, 0.2))
    for place, gap in ((near, 0.005), (far, np.inf)):
        known = Seen(last_ns=half_seen, unanswered=place[None], edges=np.array([[*place, 0.001]]))
        by_spheres, by_surface = (NearSpace(each, 0.03).look(0, LATER, known) for each in (arm, thin))
        assert (by_spheres.unanswered, by_spheres.edge) == (pytest.approx(gap), pytest.approx(gap - 0.001))
        assert (by_surface.unanswered, by_surface.edge) == (pytest.approx(gap + 0.02), pytest.approx(gap + 0.019))


def test_states_are_thinned_by_time_across_blocks() -> None:
    space = NearSpace(PlanarArm(), 0.03)
    stamps = np.arange(0, 800, 40, dtype=np.int64) * 1_000_000  # 25 Hz
    assert NEAR_EVERY_NS == 200_000_000
    still = np.repeat(PlanarArm().sphere_centers(LATER)[None], len(stamps), axis=0)
    assert space.due(stamps[:12], still[:12]) == {0: True, 5: True, 10: True}
    assert space.due(stamps[12:], still[12:]) == {3: True}  # the state at 600 ms
    assert list(space.due(np.array([10 * SECOND, 11 * SECOND]), still[:2])) == [0, 1]  # slow states are all looked at


def test_no_sphere_of_a_fast_arm_moves_a_centimetre_between_two_looks() -> None:
    arm, space = PlanarArm(), NearSpace(PlanarArm(), 0.03)
    joints = FIRST + np.linspace(0.0, 0.1, 50)[:, None]  # in 100 ms
    centers = np.stack([arm.sphere_centers(q) for q in joints])
    stamps = np.arange(50, dtype=np.int64) * 2_000_000
    first, rest = (space.due(stamps[part], centers[part]) for part in (slice(20), slice(20, None)))
    assert [at for at, is_timed in first.items() if is_timed] == [0] and not any(rest.values())
    chosen = [*first, *(20 + at for at in rest)]
    assert 3 < len(chosen) < 50
    step = np.linalg.norm(np.diff(centers, axis=0), axis=2).max()
    for first, last in zip(chosen, [*chosen[1:], 50], strict=True):
        moved = np.linalg.norm(centers[first:last] - centers[first], axis=2).max()
        assert moved < NEAR_MOVED
        if last < 50:
            assert np.linalg.norm(centers[last] - centers[first], axis=1).max() < NEAR_MOVED + step


def test_too_few_points_say_nothing() -> None:
    arm = PlanarArm()
    arm.sphere_set.radii[0] = 5.0  # the base swallows all of the arm
    found = NearSpace(arm, 0.03).look(0, FIRST, Seen(last_ns=half_seen))
    assert np.isnan(found.unseen) and np.isnan(found.age)


def test_the_nearest_place_without_an_answer_is_told_with_its_distance() -> None:
    arm = PlanarArm()
    centers, radii = arm.sphere_centers(LATER), np.asarray(arm.sphere_set.radii)
    place = centers[-1] + np.array([0.0, 0.0, radii[-1] + 0.02])
    far = centers[-1] + np.array([0.0, 0.0, radii[-1] + 1.0])
    known = Seen(last_ns=half_seen, unanswered=np.array([far, place]))
    found = NearSpace(arm, 0.03).look(0, LATER, known)
    want = np.min(np.linalg.norm(centers - place, axis=1) - radii)
    assert (found.unanswered, found.unanswered_place.tolist()) == (pytest.approx(want), place.tolist())
    nothing = NearSpace(arm, 0.03).look(0, LATER, Seen(last_ns=half_seen, unanswered=far[None]))
    assert nothing.unanswered == np.inf and np.isnan(nothing.unanswered_place).all()


def test_a_lost_edge_is_as_near_as_its_ball() -> None:
    arm = PlanarArm()
    centers, radii = arm.sphere_centers(LATER), np.asarray(arm.sphere_set.radii)
    near = centers[-1] + np.array([0.0, 0.0, radii[-1] + 0.02])
    large = centers[-1] + np.array([0.0, 0.0, radii[-1] + 0.03])
    known = Seen(last_ns=half_seen, edges=np.array([[*near, 0.001], [*large, 0.015]]))
    found = NearSpace(arm, 0.03).look(0, LATER, known)
    assert (found.edge, found.edge_place.tolist()) == (pytest.approx(0.015), large.tolist())
    nothing = NearSpace(arm, 0.03).look(0, LATER, Seen(last_ns=half_seen))
    assert nothing.edge == np.inf and np.isnan(nothing.edge_place).all()


@pytest.mark.parametrize(("away", "is_found"), [(0.09, True), (0.11, False)])
def test_a_wide_margin_is_looked_for_as_far_as_it_reaches(away: float, is_found: bool) -> None:
    """A place without depth, which is a lost edge too, off the end of the arm."""
    arm = PlanarArm()
    tip = arm.sphere_centers(LATER)[-1]
    out = tip - arm.sphere_centers(LATER)[-2]
    place = tip + out / np.linalg.norm(out) * (arm.sphere_set.radii[-1] + away)
    known = Seen(last_ns=half_seen, unanswered=place[None], edges=np.array([[*place, 1e-3]]))
    found = NearSpace(arm, 0.1).look(0, LATER, known)
    assert found.unanswered == pytest.approx(away) or not is_found
    assert found.edge == pytest.approx(away - 1e-3) or not is_found


@pytest.mark.parametrize("away", [0.02, 0.05, 0.09])
def test_an_unseen_pocket_anywhere_within_a_wide_margin_is_found(away: float) -> None:
    arm = PlanarArm()
    place = arm.sphere_centers(LATER)[-1] + np.array([0.0, 0.0, arm.sphere_set.radii[-1] + away])

    def outside(points: Float64) -> NDArray[np.int64]:
        return np.where(np.linalg.norm(points - place, axis=1) < 0.02, -1, 0)

    found = NearSpace(arm, 0.1).look(0, LATER, Seen(last_ns=outside), lambda points: np.full(len(points), 0.01))
    assert found.hidden == 0.01


def test_the_share_of_blind_spheres_is_that_of_the_reference() -> None:
    arm, space = PlanarArm(), NearSpace(PlanarArm(), 0.03)
    space.look(0, FIRST, Seen(last_ns=half_seen))
    for height in (-1.0, 0.02, 0.5):

        def seen_above(points: Float64, height: float = height) -> NDArray[np.int64]:
            return np.where(points[:, 2] > height, 0, -1)

        found = space.look(SECOND, LATER, Seen(last_ns=seen_above)).blind
        assert found == pytest.approx(blind_share(arm, LATER, FIRST, 0.03, seen_above))
    assert found == 1.0


@pytest.mark.parametrize("height", [-0.3, 0.0, 0.05, 0.4])
def test_unseen_space_at_the_margin_is_as_near_to_a_surface_as_by_the_reference(height: float) -> None:
    """A sheet seen from above alone: what is under it was never seen."""
    arm, space = PlanarArm(), NearSpace(PlanarArm(), 0.03)

    def seen(points: Float64) -> NDArray[np.int64]:
        return np.where(points[:, 2] > height, 0, -1)

    def to_sheet(points: Float64) -> Float64:
        return np.asarray(np.abs(points[:, 2] - height))

    at_first = space.look(0, FIRST, Seen(last_ns=seen), to_sheet).hidden
    assert at_first == pytest.approx(hidden(arm, FIRST, 0.03, seen, to_sheet))  # what stands there may touch it, too
    found = space.look(SECOND, LATER, Seen(last_ns=seen), to_sheet)
    assert found.hidden == pytest.approx(hidden(arm, LATER, 0.03, seen, to_sheet))
    if np.isfinite(found.hidden):
        assert found.hidden == pytest.approx(height - found.hidden_place[2])
    assert np.isfinite(found.hidden) == (height > -0.3)
    assert found.beyond == pytest.approx(beyond(arm, LATER, FIRST, 0.03, seen, to_sheet))
    assert np.isfinite(found.beyond) == (height > 0.1)  # under it spheres have both sides, beneath it one


def test_a_map_that_answers_nowhere_hides_nothing() -> None:
    space = NearSpace(PlanarArm(), 0.03)
    space.look(0, FIRST, Seen(last_ns=half_seen))
    found = space.look(SECOND, LATER, Seen(last_ns=half_seen), lambda points: np.full(len(points), np.nan))
    assert found.hidden == np.inf
