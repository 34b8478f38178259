"""Where an arm touches itself is told by its links' surfaces, whatever its spheres say; and a Franka's own."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.jobs.replay.inputs import MeasuredRobot, measured_robot
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.records import Float64, JointState, SphereSet
from splatctrl_cli.robot import self_margins
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import spheres_yaml
from splatctrl_cli.robot.sphere_fit import FitOptions, fit_spheres
from splatctrl_cli.robot.urdf import read_urdf
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.truth import closest_of
from tests.cli.replay_desk import SECOND, Desk, FakeSource, splats_of, write_scene
from tests.control.fakes import Balls, num_on_rung
from tests.robot.shapes import CROSSED, FOLDED, LIMIT, OPEN, URDF, covering_spheres, written

FAR = ((1.2, 1.2, 0.9), 0.05)
COVERING, FAT = covering_spheres(), covering_spheres(1.6)  # the fat ones overlap in every posture
BLIND = covering_spheres(parts=("block", "neck", "drum"))  # nothing stands for the blade
FAT_BLIND = covering_spheres(1.6, parts=("block", "neck", "drum"))
TALL = URDF.replace("0 0 0.052", "0 0 0.1")  # the drum turns 70 mm above the block
LOST = URDF.replace('<box size="0.1 0.1 0.1"/>', '<mesh filename="package://lost/block.stl"/>')
# a bob that slides in a post of 10 m, out of which it looks in 3 cm of its way
POST = f"""<robot name="post">
<link name="post"><collision><origin xyz="0 0 -5"/><geometry><box size="0.1 0.1 10"/></geometry></collision></link>
<link name="carriage"/>
<link name="bob"><collision><geometry><box size="0.04 0.04 0.04"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="post"/><child link="carriage"/><axis xyz="0 0 1"/>{LIMIT}</joint>
<joint name="slide" type="prismatic"><parent link="carriage"/><child link="bob"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="0.05" velocity="1" effort="1"/></joint></robot>"""
POST_SPHERES = SphereSet(links=("post", "bob"), centers=np.array([[0, 0, -0.05], [0, 0, 0]]), radii=np.full(2, 0.04))
COVER = '<collision><origin xyz="0.022 0 0.054"/><geometry><box size="0.02 0.02 0.008"/></geometry></collision>'
DRIVE = ("--mode", "closed-loop", "--set", "control.solver=daqp", "--set", "control.max_time=4")
SRDF = '<robot name="folding"><disable_collisions link1="block" link2="drum" reason="Never"/></robot>'


def desk_of(
    folder: Path, monkeypatch: pytest.MonkeyPatch, spheres: SphereSet, *postures: Float64, urdf: str = URDF
) -> Desk:
    """A replay of the folding arm from posture to posture, 20 states on each way."""
    monkeypatch.setattr(self_margins, "SELF_POSTURES", 1000)
    ways = [a + (b - a) * t for a, b in pairwise(postures) for t in np.linspace(0, 1, 20)]
    states = [JointState(stamp_ns=k * SECOND // 50, position=q, velocity=0 * q) for k, q in enumerate(ways)]
    source = FakeSource(states=states, joint_names=tuple(re.findall(r'joint name="(\w+)"', urdf)))
    monkeypatch.setattr("splatctrl_cli.jobs.replay.inputs.open_states", lambda *_: source)
    robot = ["--urdf", str(written(folder, urdf)), "--spheres"]
    desk = Desk(folder=folder, source=source, robot=[*robot, str(written(folder, spheres_yaml(spheres), "s.yaml"))])
    write_scene(folder / "scene", (0, splats_of(FAR)))
    return desk


def judged(desk: Desk, *arguments: str) -> dict[str, Any]:
    """The reason of self-clearance in the verdict of a replay."""
    desk.replay("--scene", str(desk.folder / "scene"), "-q", "--force", *arguments, is_judged=True)
    return next((reason for reason in desk.verdict()["reasons"] if reason["criterion"] == "self-clearance"), {})


def conclusion(found: dict[str, Any]) -> tuple[Any, ...]:
    """Outcome, label and pair of a reason."""
    return found["outcome"], found["label"], found["who"]


@pytest.mark.parametrize("spheres", [COVERING, FAT, BLIND], ids=["covering", "fat", "blind"])
def test_an_arm_that_folds_into_itself_is_in_contact_whatever_its_spheres_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spheres: SphereSet
) -> None:
    desk = desk_of(tmp_path, monkeypatch, spheres, OPEN, FOLDED, CROSSED, OPEN)
    found = judged(desk)
    assert conclusion(found) == ("failed", "contact", "block and drum")
    assert "block and drum overlap by 5.1 mm" in found["sentence"]
    assert desk.metrics()["min_self_clearance"] == pytest.approx(-0.0051, abs=1e-4)
    names = [e["worst_name"] for e in desk.json("events.json")["events"] if e["kind"] == "self-collision"]
    assert names == ["block and drum"]


@pytest.mark.parametrize("spheres", [COVERING, FAT], ids=["covering", "fat"])
def test_spheres_that_overlap_where_the_links_do_not_are_no_contact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spheres: SphereSet
) -> None:
    found = judged(desk_of(tmp_path, monkeypatch, spheres, -OPEN, OPEN))
    assert (found["outcome"], found["value"]) == ("passed", pytest.approx(0.022, abs=1e-4))


@pytest.mark.parametrize(
    ("above", "expected"),
    [(0.235, ("failed", "contact")), (0.2474, ("failed", "margin broken")), (0.29, ("passed", ""))],
)
def test_what_the_urdf_has_beside_the_arm_keeps_the_margin_though_no_sphere_stands_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, above: float, expected: tuple[str, str]
) -> None:
    """A shelf above the blade's way, whose highest point is 242.4 mm up, and a cover that is always 2 mm off."""
    shelf = f'<origin xyz="0 0 {above + 0.01}"/><geometry><box size="0.5 0.5 0.02"/></geometry>'
    cell = "".join(
        f'<link name="{name}">{body}</link><joint name="of_{name}" type="fixed"><parent link="block"/>'
        f'<child link="{name}"/></joint>'
        for name, body in (("shelf", f"<collision>{shelf}</collision>"), ("cover", COVER))
    )
    urdf = URDF.replace("</robot>", f"{cell}</robot>")
    desk = desk_of(tmp_path, monkeypatch, COVERING, OPEN, 0 * OPEN, -OPEN, urdf=urdf)
    desk.source.joint_names = ("turn", "fold")
    found = judged(desk)
    assert (found["outcome"], found.get("label") or "") == expected
    if expected[1] == "margin broken":
        assert "drum and shelf, one of which stands still, are 5.0 mm apart, margin 20.0 mm" in found["sentence"]
        assert found["time_s"] == pytest.approx(0.38, abs=0.03)


def test_a_pair_that_an_srdf_names_may_touch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = desk_of(tmp_path, monkeypatch, COVERING, OPEN, FOLDED)
    assert judged(desk, "--srdf", str(written(tmp_path, SRDF, "folding.srdf"))) == {}


@pytest.mark.parametrize("spheres", [COVERING, BLIND], ids=["covering", "blind"])
def test_a_lowered_margin_hides_no_contact_of_the_driven_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], spheres: SphereSet
) -> None:
    desk = desk_of(tmp_path, monkeypatch, spheres, OPEN, FOLDED)
    found, goal_reached = judged(desk, *DRIVE), desk.metrics()["goal_reached"]
    (said,) = (
        line for line in capsys.readouterr().out.splitlines() if line.startswith("self-collision margin: 20 mm")
    )
    assert "block and drum" in said
    if spheres is COVERING:  # its row stops the arm before the block, and the goal in it is not reached
        assert (found["outcome"], goal_reached, "(surfaces then" in said) == ("passed", 0, True)
    else:  # no row knows of the blade
        assert (found["outcome"], found["label"], goal_reached) == ("failed", "contact", 1)
        assert "(surfaces may touch then)" in said


@pytest.mark.parametrize(
    ("urdf", "spheres", "goal", "least"),
    [(URDF, BLIND, "0.5,2.08", 11.0), (TALL, FAT_BLIND, "0.5,2.4", 20.0)],
    ids=["never-far", "far"],
)
def test_links_apart_in_the_recording_that_a_lowered_margin_lets_come_together_are_not_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, urdf: str, spheres: SphereSet, goal: str, least: float
) -> None:
    there = np.array([float(part) for part in goal.split(",")])
    apart = desk_of(tmp_path, monkeypatch, spheres, OPEN, -OPEN, OPEN, urdf=urdf)
    found = judged(apart, *DRIVE, f"--goal-joints={goal}")
    assert (apart.metrics()["goal_reached"], apart.metrics()["num_relaxed"]) == (1, 0)
    assert conclusion(found) == ("failed", "margin broken", "block and drum")
    assert 0 < found["value"] < found["threshold"] == pytest.approx(1e-3 * least, abs=1e-6)
    said = f"were driven to {1e3 * found['value']:.1f} mm apart, recorded {least} mm or more: spheres keep"
    assert said in found["sentence"]
    assert found["time_s"] > 0.5
    assert judged(apart)["outcome"] == judged(apart, *DRIVE)["outcome"] == "passed"
    as_near = desk_of(tmp_path / "as_near", monkeypatch, spheres, OPEN, there, urdf=urdf)
    assert judged(as_near, *DRIVE)["outcome"] == judged(as_near)["outcome"] == "passed"


def test_without_surfaces_spheres_that_a_lowered_margin_lets_come_together_are_not_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desk_of(tmp_path, monkeypatch, COVERING, OPEN, -OPEN, OPEN, urdf=LOST)
    found = judged(desk, *DRIVE, "--goal-joints=0.5,1.9")
    assert conclusion(found) == ("failed", "margin broken", "block and drum")
    assert desk.metrics()["num_relaxed"] == 0 and found["value"] < found["threshold"] - 0.001


def test_links_that_hardly_any_posture_parts_are_judged_where_the_recording_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, touching, inside = np.array([[0.0, 0.04], [0.0, 0.01], [0.0, -1.0]])
    desk = desk_of(tmp_path / "inside", monkeypatch, POST_SPHERES, inside, touching, urdf=POST)
    assert judged(desk) == {}
    said = "contact not judged of links that overlap in every recorded and sampled posture: post and bob"
    assert said in capsys.readouterr().out
    desk = desk_of(tmp_path / "out", monkeypatch, POST_SPHERES, out, touching, urdf=POST)
    assert conclusion(judged(desk)) == ("failed", "contact", "post and bob")
    assert said not in capsys.readouterr().out


def test_without_geometry_spheres_that_overlap_are_a_contact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = desk_of(tmp_path, monkeypatch, COVERING, OPEN, FOLDED)
    written(tmp_path, LOST)
    assert judged(desk)["label"] == "contact"
    assert judged(desk, "--mode", "closed-loop", "--set", "control.max_time=0.2")
    assert desk.json("summary.json")["about"]["self_margins"].count("mm") >= 2


CONFIG = ControlConfig(solver="daqp", max_time=8.0)
LOGGED = [f"joint{k}" for k in range(1, 8)]
FREE = Balls([[9.0, 9.0, 9.0]], [0.1])


class Table:
    """Table, things on it and the visitor: the exact distance, and its gradient."""

    def __init__(self) -> None:
        self.solids = [*tabletop.furniture(), *tabletop.objects(), tabletop.visitor(0, 1)]

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        distance, surface = closest_of(self.solids, points, 0)
        offset = (points - surface) * np.sign(distance)[:, None]
        return distance, offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)


@pytest.fixture(scope="module")
def fr3(real_data: Path) -> MeasuredRobot:
    """A robot with 64 spheres, the default of `robot spheres`, from a quicker fit."""
    folder = real_data / "franka_description"
    urdf = folder / "expanded" / "fr3_hand.urdf"
    quick = FitOptions(max_spheres=64, restarts=1, num_patches=1000, num_candidates=1200)
    spheres = fit_spheres(read_solids(read_urdf(urdf), [folder]), quick)
    return measured(RobotModel.from_urdf(urdf, spheres), "fr3", folder)


@pytest.fixture(scope="module")
def panda(real_data: Path) -> MeasuredRobot:
    """With cuRobo's spheres."""
    urdf = real_data / "vamp_panda/resources/panda/panda.urdf"
    spheres = real_data / "robot_spheres/curobo/curobo/content/configs/robot/franka.yml"
    return measured(RobotModel.from_urdf(urdf, spheres), "panda", urdf.parent)


def measured(model: RobotModel, name: str, packages: Path) -> MeasuredRobot:
    urdf = model.urdf.path
    request = ReplayRequest(log=urdf, urdf=urdf, out=urdf, mode="closed-loop", packages=(packages,))
    return measured_robot(request, model.moved_by([f"{name}_{joint}" for joint in LOGGED]), CONFIG)


def driven(model: RobotModel, field: Table | Balls, config: ControlConfig = CONFIG) -> ReplayTrace:
    """The arm is driven over the last 3 s of the log."""
    motion, frame = tabletop.arm_motion(7.0), model.frame_names[-1]
    task = ReplayTask(start=motion.at(4.0)[0], T_world_goal=model.frame_pose(motion.at(7.0)[0], frame), frame=frame)
    return closed_loop(model, config, task, lambda _: field)


@pytest.mark.parametrize("name", ["fr3", "panda"])
def test_the_closed_loop_arrives_with_every_step_solved(name: str, request: pytest.FixtureRequest) -> None:
    robot: MeasuredRobot = request.getfixturevalue(name)
    trace = driven(robot.model, Table())
    assert (trace.outcome, num_on_rung(trace, Rung.SOLVED)) == (Outcome.GOAL_REACHED, len(trace.steps))
    assert {step.scale for step in trace.steps} == {1.0}
    q = np.asarray(trace.position)[::20]
    assert robot.surfaces.gaps(q, robot.model.sphere_centers_batch(q), 0.02).min() > 0.02
    assert min(step.clearance for step in trace.steps) > 0.02 - 1e-3


def test_the_margin_as_asked_for_relaxes_every_step_of_an_fr3(fr3: MeasuredRobot) -> None:
    asked = fr3.model.replace_self_allowance(np.zeros(len(fr3.model.self_pairs())))
    trace = driven(asked, FREE, replace(CONFIG, max_time=0.4))
    assert num_on_rung(trace, Rung.RELAXED) == len(trace.steps) == 40


def test_what_the_pairs_of_an_fr3_keep_keeps_their_surfaces_apart(fr3: MeasuredRobot) -> None:
    assert {pair.links for pair in fr3.pair_margins} == {("fr3_link5", "fr3_link7"), ("fr3_link5", "fr3_hand")}
    assert all(-0.015 < pair.margin < 0.02 and pair.surface_gap > 0.01 for pair in fr3.pair_margins)


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
    (kept,) = panda.pair_margins
    assert kept.links == ("panda_link5", "panda_link7") and kept.surface_gap < 0


def nearest(robot: MeasuredRobot, q: Float64) -> float:
    return float(robot.surfaces.gaps(q[None], robot.model.sphere_centers_batch(q[None]), 0.02).min())


def sphere_gap(model: RobotModel, q: Float64, one: str, other: str) -> float:
    """Between the spheres of two links, by the ends of their names."""
    centers, radii = model.sphere_centers(q), model.sphere_set.radii
    a, b = (np.array([link.endswith(end) for link in model.sphere_set.links]) for end in (one, other))
    apart = np.linalg.norm(centers[a][:, None] - centers[b][None], axis=2)
    return float((apart - radii[a][:, None] - radii[b][None]).min())
