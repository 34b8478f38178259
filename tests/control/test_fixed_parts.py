"""What comes near the links that no joint moves: balls beside the base of a planar arm, whose sphere is 6 cm."""

import numpy as np
import pytest

from splatctrl_cli.control.audit import DistanceFunction
from splatctrl_cli.control.fixed_parts import FixedParts
from splatctrl_cli.records import Float64, SphereSet
from tests.control.fakes import PlanarArm, ThinArm, scene_of

Q = np.zeros(2)
FREE = [0.0, 0.5, 0.0]  # a ball far from the base


def looked(*scenes: DistanceFunction, arm: PlanarArm | None = None) -> dict[str, tuple[float, float]]:
    parts = FixedParts(arm or ThinArm(), 0.04)
    for scene in scenes:
        parts.look(scene, Q, lambda places: np.ones(len(places), bool))
    return parts.found


def beside(gap: float) -> DistanceFunction:
    """A scene with a ball of 1 cm, `gap` from the base's sphere."""
    return scene_of([FREE, [0.0, 0.06 + 0.01 + gap, 0.0]], [0.01, 0.01])


@pytest.mark.parametrize(
    ("gap", "later", "has_come"),
    [(0.1, 0.092, False), (0.1, 0.05, True), (0.03, 0.001, False), (0.03, -0.002, False), (0.03, -0.022, True)],
)
def test_what_moves_by_more_than_a_map_does_has_come(gap: float, later: float, has_come: bool) -> None:
    """By a centimetre, or by three beside a sphere at its mount. The surface is 2 cm within the sphere."""
    found = looked(beside(gap), beside(later), beside(later))
    first, least = found["base[0]"]
    assert first == pytest.approx(gap)
    assert least == pytest.approx(later + 0.02 if has_come else gap)


def test_spheres_say_how_near_a_link_without_triangles_is() -> None:
    class BallArm(PlanarArm):
        def surface_gaps(self, *_: object) -> dict[str, Float64]:
            return {}

    assert looked(beside(0.1), beside(0.0), beside(0.0), arm=BallArm())["base[0]"][1] == pytest.approx(0.0)


def test_what_is_seen_for_the_first_time_did_not_come_and_stands_there_from_then_on() -> None:
    parts, before, after = FixedParts(ThinArm(), 0.04), beside(0.4), beside(0.0)
    parts.look(before, Q, None)
    parts.look(after, Q, lambda places: places[:, 1] > 0.3)
    for _ in range(2):
        parts.look(after, Q, lambda places: np.ones(len(places), bool))
    assert parts.found["base[0]"][1] == pytest.approx(0.4, abs=0.05)


def test_what_one_scene_alone_has_is_noise() -> None:
    """A thing that comes by 5 cm a scene is there in each; one that is elsewhere in the next was nowhere."""
    assert looked(beside(0.1), beside(0.0), beside(0.1), beside(0.0))["base[0]"][1] == pytest.approx(0.1)
    coming = [beside(gap) for gap in (0.1, 0.06, 0.035, 0.01)]
    assert looked(*coming)["base[0]"][1] == pytest.approx(0.03)


def test_each_sphere_has_what_is_nearest_to_it() -> None:
    """The base with a second sphere 30 cm away: what comes to one says nothing of the other."""
    arm, second = ThinArm(), [-0.3, 0.0, 0.0]
    spheres, own = arm.sphere_set, arm.sphere_centers
    arm.sphere_set = SphereSet(
        links=("base", *spheres.links),
        centers=np.concatenate([[second], spheres.centers]),
        radii=np.append(0.06, spheres.radii),
    )
    arm.moving_spheres = np.append(False, arm.moving_spheres)

    def centers_at(q: Float64) -> Float64:
        arm.sphere_set, both = spheres, arm.sphere_set
        centers = np.concatenate([[second], own(q)])
        arm.sphere_set = both
        return centers

    arm.sphere_centers = centers_at  # type: ignore[method-assign]
    scene = scene_of([FREE, [0.0, 0.1, 0.0], [-0.3, 0.11, 0.0]], [0.01, 0.01, 0.01])
    found = looked(scene_of([FREE], [0.01]), scene, scene, arm=arm)
    assert [least for _, least in found.values()] == pytest.approx([0.06, 0.05])


def test_a_scene_of_no_balls_is_measured_from_the_spheres() -> None:
    far, near = (lambda points, d=d: np.full(len(points), d) for d in (0.2, 0.05))
    assert looked(far, near, arm=PlanarArm())["base[0]"] == (pytest.approx(0.14), pytest.approx(-0.01))
