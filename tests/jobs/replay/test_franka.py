"""A Franka as it is sold, FR3 and Panda: the closed loop of the README in free space and beside a table, by default
settings, and contact of its links that its spheres do not show. Real robot models, the scene exact.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.jobs.replay.inputs import MeasuredRobot, measured_robot
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_fit import FitOptions, fit_spheres
from splatctrl_cli.robot.urdf import read_urdf
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.truth import closest_of
from tests.control.fakes import Balls, num_on_rung

CONFIG = ControlConfig(solver="daqp", max_time=8.0)
LOGGED = [f"joint{k}" for k in range(1, 8)]
FREE = Balls([[9.0, 9.0, 9.0]], [0.1])


class Table:
    """Table, things on it and the visitor: the exact distance, and its gradient."""

    def __init__(self) -> None:
        self.solids = [*tabletop.furniture(), *tabletop.things(), tabletop.visitor(0, 1)]

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        distance, surface = closest_of(self.solids, points, 0)
        offset = (points - surface) * np.sign(distance)[:, None]
        return distance, offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)


@pytest.fixture(scope="module")
def fr3(real_data: Path) -> MeasuredRobot:
    """With the 64 spheres that `robot spheres` fits by default."""
    folder = real_data / "franka_description"
    urdf = folder / "expanded" / "fr3_hand.urdf"
    spheres = fit_spheres(read_solids(read_urdf(urdf), [folder]), FitOptions(max_spheres=64))
    model = RobotModel.from_urdf(urdf, spheres).moved_by([f"fr3_{name}" for name in LOGGED])
    return measured(model, urdf, folder)


@pytest.fixture(scope="module")
def panda(real_data: Path) -> MeasuredRobot:
    """With cuRobo's spheres."""
    urdf = real_data / "vamp_panda/resources/panda/panda.urdf"
    spheres = real_data / "robot_spheres/curobo/curobo/content/configs/robot/franka.yml"
    model = RobotModel.from_urdf(urdf, spheres).moved_by([f"panda_{name}" for name in LOGGED])
    return measured(model, urdf, urdf.parent)


def measured(model: RobotModel, urdf: Path, packages: Path) -> MeasuredRobot:
    request = ReplayRequest(log=urdf, urdf=urdf, out=urdf, mode="closed-loop", packages=(packages,))
    return measured_robot(request, model, CONFIG)


def driven(model: RobotModel, field: Table | Balls, config: ControlConfig = CONFIG) -> ReplayTrace:
    """From where the README's closed loop starts to where its log ends."""
    motion, frame = tabletop.arm_motion(7.0), model.frame_names[-1]
    goal = model.frame_pose(motion.at(7.0)[0], frame)
    task = ReplayTask(start=motion.at(1.6)[0], T_world_goal=goal, frame=frame)
    return closed_loop(model, config, task, lambda _: field)


@pytest.mark.parametrize("scene", [lambda: FREE, Table], ids=["free", "table"])
@pytest.mark.parametrize("name", ["fr3", "panda"])
def test_the_closed_loop_arrives_with_every_step_solved(
    name: str, scene: Callable[[], Table | Balls], request: pytest.FixtureRequest
) -> None:
    robot: MeasuredRobot = request.getfixturevalue(name)
    trace = driven(robot.model, scene())
    assert trace.outcome is Outcome.GOAL_REACHED
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert all(step.scale == 1.0 for step in trace.steps)
    q = np.asarray(trace.position)[::20]
    assert robot.surfaces is not None
    assert robot.surfaces.gaps(q, robot.model.sphere_centers_batch(q), 0.02).min() > 0.02
    assert min(step.clearance for step in trace.steps) > 0.02 - 1e-3


def test_the_margin_as_asked_for_relaxes_every_step_of_an_fr3(fr3: MeasuredRobot) -> None:
    asked = fr3.model.with_self_allowance(np.zeros(len(fr3.model.self_pairs())))
    trace = driven(asked, FREE, replace(CONFIG, max_time=0.4))
    assert num_on_rung(trace, Rung.RELAXED) == len(trace.steps) == 40


def test_what_the_pairs_of_an_fr3_keep_keeps_their_surfaces_apart(fr3: MeasuredRobot) -> None:
    kept = {pair.links: pair for pair in fr3.kept}
    assert set(kept) == {("fr3_link5", "fr3_link7"), ("fr3_link5", "fr3_hand")}
    for pair in kept.values():
        assert pair.margin is not None and -0.01 < pair.margin < 0.02
        assert pair.surface_gap is not None and pair.surface_gap > 0.01


# joint6 and joint7 [rad], the sphere gap at least or at most, and whether link5 and link7 touch
@pytest.mark.parametrize(("at", "spheres", "touches"), [((0.56, 2.1), -0.01, True), ((4.3, 0.0), -0.002, False)])
def test_an_fr3_touches_itself_where_its_surfaces_do_and_not_where_its_spheres_do(
    fr3: MeasuredRobot, at: tuple[float, float], spheres: float, touches: bool
) -> None:
    q = np.array([0.0, -0.8, 0.0, -2.3, 0.0, *at])
    assert sphere_gap(fr3.model, q, "link5", "link7") < spheres
    assert (nearest(fr3, q) < 0) == touches


def test_a_panda_touches_itself_where_curobos_spheres_are_apart(panda: MeasuredRobot) -> None:
    q = np.array([0.0, -0.8, 0.0, -2.3, 0.0, 0.2, 2.0])
    assert sphere_gap(panda.model, q, "link5", "link7") > 0.015
    assert nearest(panda, q) < 0
    (kept,) = panda.kept
    assert kept.links == ("panda_link5", "panda_link7") and kept.surface_gap is not None and kept.surface_gap < 0


def nearest(robot: MeasuredRobot, q: Float64) -> float:
    assert robot.surfaces is not None
    return float(robot.surfaces.gaps(q[None], robot.model.sphere_centers_batch(q[None]), 0.02).min())


def sphere_gap(model: RobotModel, q: Float64, one: str, other: str) -> float:
    """Between the spheres of two links, by the ends of their names."""
    centers, radii = model.sphere_centers(q), model.sphere_set.radii
    a, b = (np.array([link.endswith(end) for link in model.sphere_set.links]) for end in (one, other))
    apart = np.linalg.norm(centers[a][:, None] - centers[b][None], axis=2)
    return float((apart - radii[a][:, None] - radii[b][None]).min())
