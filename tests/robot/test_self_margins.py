"""Pairs of links get the margin that their spheres can keep, which still keeps their surfaces apart; and how far the
surfaces of links are from each other.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from experiments.solids import Solids
from splatctrl_cli.config import ControlConfig
from splatctrl_cli.config.fixed import LEAST_OVERLAP
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.formats.mesh import TriangleMesh
from splatctrl_cli.geometry import pose_at, transform_points
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot.link_meshes import MeshDistance, Solid, read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import random_postures
from splatctrl_cli.robot.self_margins import (
    KeptMargin,
    LinkSurface,
    SelfSurfaces,
    apply_kept_margins,
    depth_in,
    kept_margins,
    surface_gap,
)
from splatctrl_cli.robot.urdf import read_urdf
from tests.control.fakes import Balls, num_on_rung
from tests.reference.mesh_gap import surface_distance
from tests.robot.shapes import (
    CROSSED,
    FOLDED,
    GAP,
    OPEN,
    URDF,
    arm_of,
    covering_spheres,
    folding_arm,
    l_shape,
    written,
)


def turned(rng: np.random.Generator) -> Float64:
    return np.asarray(Rotation.random(rng=rng).as_matrix())


def solids_of(folder: Path, shape: str) -> tuple[Solid, ...]:
    return read_solids(read_urdf(written(folder, arm_of(shape, '<sphere radius="0.1"/>'))))["base"]


def box(folder: Path, x: float, y: float, z: float) -> LinkSurface:
    return LinkSurface(solids_of(folder, f'<box size="{x} {y} {z}"/>'))


def hook() -> Solid:
    mesh = l_shape()
    shape = TriangleMesh(vertices=np.array(mesh.vertices), faces=np.array(mesh.faces), is_closed=True)
    return Solid(link="a", surface=shape, slack=0.0, body=shape)


def test_boxes_are_as_far_apart_as_their_faces_edges_and_corners_at_any_scale(tmp_path: Path) -> None:
    gaps = {(0.3, 0.05, 0): 0.1, (0.3, 0.4, 0): np.hypot(0.1, 0.2), (0.3, 0.3, 0.3): 0.1 * 3**0.5}
    for scale in (1.0, 2.0, 4.0):
        one = box(tmp_path, *np.full(3, 0.2 * scale))
        for shift, gap in gaps.items():
            assert surface_gap(one, one, pose_at(scale * np.array(shift))) == pytest.approx(scale * gap, rel=1e-9)


def test_the_gap_is_that_of_the_reference_and_the_same_from_either_side(tmp_path: Path) -> None:
    (plate,) = solids_of(tmp_path, '<box size="0.2 0.3 0.02"/>')
    a, b = LinkSurface([hook()]), LinkSurface([plate])
    rng, found = np.random.default_rng(2), []
    for _ in range(12):
        T = pose_at(rng.uniform([-0.25, -0.25, -0.35], [0.55, 0.55, 0.45]), turned(rng))
        expected = surface_distance(hook().surface.corners, transform_points(T, plate.surface.corners))
        found.append(surface_gap(a, b, T))
        assert found[-1] == pytest.approx(expected, abs=1e-9) if expected > 0 else found[-1] < 0
        assert surface_gap(b, a, np.linalg.inv(T)) == pytest.approx(found[-1], abs=1e-9)
    assert 1 < sum(gap < 0 for gap in found) < 11


ROD, BEAM, LARGE, SMALL = (0.02, 0.02, 0.4), (0.4, 0.03, 0.03), (0.4, 0.4, 0.4), (0.02, 0.02, 0.02)


@pytest.mark.parametrize(
    ("one", "other", "shift", "gap"),
    [
        pytest.param(ROD, BEAM, (0, 0, 0), -LEAST_OVERLAP, id="cross without a vertex inside"),
        pytest.param(ROD, BEAM, (0, 0.03, 0), 0.005, id="pass each other"),
        pytest.param(LARGE, SMALL, (0, 0, 0), -0.19, id="in the middle of another"),
        pytest.param(SMALL, LARGE, (0, 0, 0), -0.19, id="around the middle of another"),
        pytest.param(LARGE, SMALL, (0.195, 0, 0), -0.015, id="half inside"),
    ],
)
def test_boxes_overlap_by_their_depth_in_each_other(
    tmp_path: Path, one: ArrayLike, other: ArrayLike, shift: ArrayLike, gap: float
) -> None:
    a, b = (box(tmp_path, *np.asarray(size)) for size in (one, other))
    assert surface_gap(a, b, pose_at(np.asarray(shift))) == pytest.approx(gap, abs=1e-12)


def test_the_depth_in_a_solid_is_the_distance_to_its_surface(tmp_path: Path) -> None:
    rng, rod = np.random.default_rng(3), '<cylinder radius="0.05" length="0.3"/>'
    for solid in (*solids_of(tmp_path, rod), *solids_of(tmp_path, '<box size="0.2 0.3 0.02"/>'), hook()):
        corners = solid.surface.vertices
        points = rng.uniform(corners.min(axis=0), corners.max(axis=0), (300, 3))
        expected = -MeshDistance(solid.surface).signed(points)
        assert np.count_nonzero(expected > 0) > 30
        np.testing.assert_allclose(np.maximum(depth_in(solid)(points), 0), np.maximum(expected, 0), atol=1e-12)


def test_round_shapes_are_never_said_to_be_farther_apart_than_they_are(tmp_path: Path) -> None:
    ball = LinkSurface(solids_of(tmp_path, '<sphere radius="0.1"/>'))
    rng = np.random.default_rng(1)
    for direction in rng.normal(size=(20, 3)):
        gap = surface_gap(ball, ball, pose_at(0.25 * direction / np.linalg.norm(direction), turned(rng)))
        assert 0.05 - 4 * ball.slack < gap <= 0.05
    assert surface_gap(ball, ball, pose_at((0.1999, 0, 0))) < 0


def test_an_open_surface_is_crossed_and_has_no_inside(tmp_path: Path) -> None:
    whole = solids_of(tmp_path, '<box size="0.2 0.2 0.2"/>')[0].surface
    sheet = TriangleMesh(vertices=whole.vertices, faces=whole.faces[2:], is_closed=False)
    tray = LinkSurface([Solid(link="a", surface=sheet, slack=0.0, body=whole)])
    pin = box(tmp_path, 0.02, 0.02, 0.02)
    assert surface_gap(tray, pin, np.eye(4)) == pytest.approx(0.09)
    assert surface_gap(tray, pin, pose_at((0, 0, 0.1))) < 0


def nearest(model: RobotModel, surfaces: SelfSurfaces, *postures: Float64, enough: float = 0.05) -> Float64:
    q = np.array(postures)
    return surfaces.gaps(q, model.sphere_centers_batch(q), enough).min(axis=1, initial=np.inf)


def test_bounds_from_spheres_never_exceed_the_gap_of_the_surfaces(tmp_path: Path) -> None:
    for scale in (1.0, 0.6):
        model, surfaces = folding_arm(tmp_path, covering_spheres(scale))
        postures = random_postures(model, 60, seed=3)
        told = nearest(model, surfaces, *postures, enough=-np.inf)
        exact = np.array([surfaces.gap(q, ("block", "drum")) for q in postures])
        assert np.all(told <= np.maximum(exact, 0.0) + 1e-9)
        np.testing.assert_array_equal(nearest(model, surfaces, *postures, enough=np.inf), exact)


NO_SPHERES = SphereSet(links=(), centers=np.zeros((0, 3)), radii=np.zeros(0))


@pytest.mark.parametrize(
    "spheres",
    [*map(covering_spheres, (1.0, 1.6, 0.6, 0.1)), covering_spheres(parts=("block", "neck")), NO_SPHERES],
    ids=["covering", "large", "small", "tiny", "none of the drum", "none"],
)
def test_spheres_that_stick_out_or_leave_much_or_all_uncovered_fool_nobody(
    tmp_path: Path, spheres: SphereSet
) -> None:
    model, surfaces = folding_arm(tmp_path, spheres)
    assert surfaces.pairs == (("block", "drum"),)
    found = nearest(model, surfaces, OPEN, FOLDED, CROSSED)
    assert found[0] == pytest.approx(GAP, abs=1e-4) and found[1] < -0.004 and found[2] < 0


def test_a_body_without_geometry_is_judged_by_its_spheres(tmp_path: Path) -> None:
    bare = URDF[: URDF.index('<link name="drum">')] + '<link name="drum"/>' + URDF[URDF.index('<joint name="turn"') :]
    model, surfaces = folding_arm(tmp_path, covering_spheres(), bare)
    assert surfaces.pairs == () and set(surfaces.names) == {"block and drum"}
    assert nearest(model, surfaces, FOLDED)[0] < 0 < nearest(model, surfaces, OPEN)[0]


def test_pairs_of_an_srdf_or_that_no_posture_parts_are_not_judged(tmp_path: Path) -> None:
    model, _ = folding_arm(tmp_path, covering_spheres())
    silent = SelfSurfaces(model, read_solids(model.urdf), {frozenset(("drum", "block"))})
    assert silent.pairs == silent.names == () and nearest(model, silent, FOLDED)[0] == np.inf
    assert folding_arm(tmp_path, covering_spheres(), URDF.replace('xyz="0 0 0.052"', 'xyz="0 0 0.02"'))[1].pairs == ()


MARGIN = 0.02
FAR = Balls([[9.0, 9.0, 9.0]], [0.1])


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[RobotModel, SelfSurfaces]:
    return folding_arm(tmp_path_factory.mktemp("arm"), covering_spheres())


@pytest.fixture(scope="module")
def kept(arm: tuple[RobotModel, SelfSurfaces]) -> KeptMargin:
    (kept,) = kept_margins(arm[0], MARGIN, arm[1])
    return kept


@pytest.fixture(scope="module")
def eased(arm: tuple[RobotModel, SelfSurfaces], kept: KeptMargin) -> RobotModel:
    return apply_kept_margins(arm[0], MARGIN, [kept])


def sphere_gaps(model: RobotModel, postures: Float64) -> Float64:
    """(T,) of block and drum, as its rows have them."""
    a, b = model.self_pairs().T
    centers, radii = model.sphere_centers_batch(postures), model.sphere_set.radii
    return np.asarray((np.linalg.norm(centers[:, a] - centers[:, b], axis=2) - radii[a] - radii[b]).min(axis=1))


def test_a_margin_that_the_spheres_keep_stays_as_it_was_asked_for(tmp_path: Path) -> None:
    near, surfaces = folding_arm(tmp_path, covering_spheres())
    assert sphere_gaps(near, random_postures(near, 500, seed=1)).max() < 0.01
    assert kept_margins(near.replace_self_pairs(np.zeros((0, 2), dtype=np.int64)), MARGIN, surfaces) == ()
    far, surfaces = folding_arm(tmp_path, covering_spheres(), URDF.replace("0 0 0.052", "0 0 0.09"))
    assert sphere_gaps(far, random_postures(far, 500, seed=1)).min() < 0.0
    assert kept_margins(far, MARGIN, surfaces) == ()


def test_a_pair_that_is_never_apart_keeps_what_keeps_its_surfaces_apart(
    arm: tuple[RobotModel, SelfSurfaces], kept: KeptMargin, tmp_path: Path
) -> None:
    model, surfaces = arm
    assert kept.links == ("block", "drum") and kept.margin is not None and kept.surface_gap is not None
    postures = random_postures(model, 800, seed=1)  # others than those it was chosen by
    spheres = sphere_gaps(model, postures)
    surface = np.array([surfaces.gap(q, kept.links) for q in postures])
    assert np.mean(surface < 0) > 0.05 and kept.surface_gap > 0.4 * GAP
    assert surface[spheres >= kept.margin].min() > 0.3 * GAP
    assert np.mean(spheres[surface > 0.9 * GAP] >= kept.margin) > 0.9
    bare, surfaces = folding_arm(tmp_path, covering_spheres(parts=("block", "neck", "drum")))
    (told,) = kept_margins(bare, MARGIN, surfaces)  # spheres that do not tell when surfaces meet are known for it
    assert 0 < told.margin < 0.01 and told.surface_gap < 0


def test_without_surfaces_spheres_are_never_let_overlap(arm: tuple[RobotModel, SelfSurfaces], tmp_path: Path) -> None:
    (kept,) = kept_margins(arm[0], MARGIN, None)
    assert kept.margin is not None and 0 <= kept.margin < 0.01 and kept.surface_gap is None
    fat = covering_spheres(1.2)
    every = np.array([(a, b) for a in range(8) for b in range(9, len(fat.links))], dtype=np.int64)
    (kept,) = kept_margins(folding_arm(tmp_path, fat)[0].replace_self_pairs(every), MARGIN, None)
    assert kept.margin is None and kept.surface_gap is None


def test_rows_and_planner_keep_the_margin_of_their_pair(
    arm: tuple[RobotModel, SelfSurfaces], kept: KeptMargin, eased: RobotModel
) -> None:
    model, _ = arm
    np.testing.assert_allclose(MARGIN - eased.self_allowance, kept.margin)
    np.testing.assert_array_equal(model.self_allowance, 0.0)
    moving = int(model.moving_spheres.sum())
    before, after = (
        Clearance.of(m, Solids(solids=()), self_margin=MARGIN).rows(random_postures(model, 5, seed=0))
        for m in (model, eased)
    )
    np.testing.assert_array_equal(before[:, :moving], after[:, :moving])
    np.testing.assert_allclose(after[:, moving:] - before[:, moving:], MARGIN - kept.margin)


def moved(arm: RobotModel, start: ArrayLike, goal: ArrayLike) -> ReplayTrace:
    """The closed loop from one posture towards where the drum is in another."""
    task = ReplayTask(start=np.array(start), T_world_goal=arm.frame_pose(np.array(goal), "drum"), frame="drum")
    return closed_loop(arm, ControlConfig(solver="daqp", max_time=6.0), task, lambda _: FAR)


def test_the_controller_reaches_its_goal_where_the_pair_can_keep_its_margin(
    arm: tuple[RobotModel, SelfSurfaces], eased: RobotModel
) -> None:
    asked, kept = (moved(model, [0.6, 0.9], [-0.6, -0.9]) for model in (arm[0], eased))
    assert num_on_rung(asked, Rung.RELAXED) == len(asked.steps)
    assert (kept.outcome, num_on_rung(kept, Rung.RELAXED)) == (Outcome.GOAL_REACHED, 0)


def test_the_controller_stops_before_the_surfaces_meet(
    arm: tuple[RobotModel, SelfSurfaces], eased: RobotModel
) -> None:
    trace = moved(eased, [0.3, 1.0], [0.3, 2.3])
    assert trace.outcome is Outcome.STALLED
    assert min(arm[1].gap(q, ("block", "drum")) for q in trace.position[::10]) > 0.3 * GAP
