"""Pairs of links get the margin that their spheres can keep, which still keeps their surfaces apart."""

from pathlib import Path

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTask, closed_loop, num_on_rung
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.planner.solid_scene import Solids
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import random_postures
from splatctrl_cli.robot.self_margins import kept_margins, with_kept_margins
from tests.control.fakes import Balls
from tests.robot.folding_arm import GAP, URDF, covering_spheres, folding_arm

MARGIN = 0.02
FAR = Balls([[9.0, 9.0, 9.0]], [0.1])


def sphere_gaps(model: RobotModel, postures: Float64) -> Float64:
    """(T,) of block and drum, as its rows have them."""
    a, b = model.self_pairs().T
    centers, radii = model.sphere_centers_batch(postures), model.sphere_set.radii
    return np.asarray((np.linalg.norm(centers[:, a] - centers[:, b], axis=2) - radii[a] - radii[b]).min(axis=1))


def test_a_margin_that_the_spheres_keep_stays_as_it_was_asked_for(tmp_path: Path) -> None:
    near, surfaces = folding_arm(tmp_path, covering_spheres())
    assert sphere_gaps(near, random_postures(near, 500, seed=1)).max() < 0.01
    assert kept_margins(near.with_self_pairs(np.zeros((0, 2), dtype=np.int64)), MARGIN, surfaces) == ()
    far, surfaces = folding_arm(tmp_path, covering_spheres(), URDF.replace("0 0 0.052", "0 0 0.09"))
    assert sphere_gaps(far, random_postures(far, 500, seed=1)).min() < 0.0
    assert kept_margins(far, MARGIN, surfaces) == ()


def test_a_pair_that_is_never_apart_keeps_what_keeps_its_surfaces_apart(tmp_path: Path) -> None:
    model, surfaces = folding_arm(tmp_path, covering_spheres())
    (kept,) = kept_margins(model, MARGIN, surfaces)
    assert kept.links == ("block", "drum") and kept.margin is not None and kept.surface_gap is not None
    postures = random_postures(model, 800, seed=1)  # others than those it was chosen by
    spheres = sphere_gaps(model, postures)
    surface = np.array([surfaces.gap(q, kept.links) for q in postures])
    assert np.mean(surface < 0) > 0.05 and kept.surface_gap > 0.4 * GAP
    assert surface[spheres >= kept.margin].min() > 0.3 * GAP
    assert np.mean(spheres[surface > 0.9 * GAP] >= kept.margin) > 0.9


def test_spheres_that_do_not_tell_when_surfaces_meet_are_known_for_it(tmp_path: Path) -> None:
    model, surfaces = folding_arm(tmp_path, covering_spheres(parts=("block", "neck", "drum")))
    (kept,) = kept_margins(model, MARGIN, surfaces)
    assert kept.margin is not None and kept.surface_gap is not None
    assert 0 < kept.margin < 0.01 and kept.surface_gap < 0


def test_without_surfaces_spheres_are_never_let_overlap(tmp_path: Path) -> None:
    model, _ = folding_arm(tmp_path, covering_spheres())
    (kept,) = kept_margins(model, MARGIN, None)
    assert kept.margin is not None and 0 <= kept.margin < 0.01 and kept.surface_gap is None
    fat = covering_spheres(1.2)
    every = np.array([(a, b) for a in range(8) for b in range(9, len(fat.links))], dtype=np.int64)
    model = folding_arm(tmp_path, fat)[0].with_self_pairs(every)
    (kept,) = kept_margins(model, MARGIN, None)
    assert kept.margin is None and kept.surface_gap is None


def test_rows_and_planner_keep_the_margin_of_their_pair(tmp_path: Path) -> None:
    model, surfaces = folding_arm(tmp_path, covering_spheres())
    kept = kept_margins(model, MARGIN, surfaces)
    eased = with_kept_margins(model, MARGIN, kept)
    assert kept[0].margin is not None
    np.testing.assert_allclose(MARGIN - eased.self_allowance, kept[0].margin)
    np.testing.assert_array_equal(model.self_allowance, 0.0)
    q = random_postures(model, 5, seed=0)
    moving = int(model.moving_spheres.sum())
    nothing = Solids(solids=())
    before, after = (Clearance.of(m, nothing, self_margin=MARGIN).rows(q) for m in (model, eased))
    np.testing.assert_array_equal(before[:, :moving], after[:, :moving])
    np.testing.assert_allclose(after[:, moving:] - before[:, moving:], MARGIN - kept[0].margin)


def test_the_controller_reaches_its_goal_where_the_pair_can_keep_its_margin(tmp_path: Path) -> None:
    model, surfaces = folding_arm(tmp_path, covering_spheres())
    eased = with_kept_margins(model, MARGIN, kept_margins(model, MARGIN, surfaces))
    config = ControlConfig(solver="daqp", max_time=6.0)
    task = ReplayTask(
        start=np.array([0.6, 0.9]), T_world_goal=model.frame_pose(np.array([-0.6, -0.9]), "drum"), frame="drum"
    )
    outcomes = {}
    for name, arm in (("asked", model), ("kept", eased)):
        trace = closed_loop(arm, config, task, lambda _: FAR)
        outcomes[name] = trace.outcome, num_on_rung(trace, Rung.RELAXED) / len(trace.steps)
    assert outcomes["asked"][1] == 1.0
    assert outcomes["kept"] == (Outcome.GOAL_REACHED, 0.0)


def test_the_controller_stops_before_the_surfaces_meet(tmp_path: Path) -> None:
    model, surfaces = folding_arm(tmp_path, covering_spheres())
    eased = with_kept_margins(model, MARGIN, kept_margins(model, MARGIN, surfaces))
    task = ReplayTask(
        start=np.array([0.3, 1.0]), T_world_goal=model.frame_pose(np.array([0.3, 2.3]), "drum"), frame="drum"
    )
    trace = closed_loop(eased, ControlConfig(solver="daqp", max_time=6.0), task, lambda _: FAR)
    assert trace.outcome is Outcome.STALLED
    assert min(surfaces.gap(q, ("block", "drum")) for q in trace.position[::10]) > 0.3 * GAP
