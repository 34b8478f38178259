"""Where an arm touches itself is told by its links' surfaces, whatever its spheres say and its rows may keep."""

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.records import Float64, JointState, SphereSet
from splatctrl_cli.robot.sphere_files import spheres_yaml
from tests.cli.replay_desk import SECOND, Desk, FakeSource, splats_of, write_scene
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

pytestmark = pytest.mark.usefixtures("unpainted")


def desk_of(
    folder: Path, monkeypatch: pytest.MonkeyPatch, spheres: SphereSet, *postures: Float64, urdf: str = URDF
) -> Desk:
    """A replay of the folding arm from posture to posture, 20 states on each way."""
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
    verdict = json.loads((desk.folder / "out" / "summary.json").read_text())["verdict"]
    found = [reason for reason in verdict["reasons"] if reason["criterion"] == "self-clearance"]
    return found[0] if found else {}


@pytest.mark.parametrize("spheres", [COVERING, FAT, BLIND], ids=["covering", "fat", "blind"])
def test_an_arm_that_folds_into_itself_is_in_contact_whatever_its_spheres_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spheres: SphereSet
) -> None:
    desk = desk_of(tmp_path, monkeypatch, spheres, OPEN, FOLDED, CROSSED, OPEN)
    found = judged(desk)
    assert (found["outcome"], found["label"], found["who"]) == ("failed", "contact", "block and drum")
    assert "block and drum are 5.1 mm deep in each other" in found["sentence"]
    assert desk.metrics()["min_self_clearance"] == pytest.approx(-0.0051, abs=1e-4)
    (event,) = [
        one
        for one in json.loads((tmp_path / "out" / "events.json").read_text())["events"]
        if one["kind"] == "self-collision"
    ]
    assert event["worst_name"] == "block and drum"


@pytest.mark.parametrize("spheres", [COVERING, FAT], ids=["covering", "fat"])
def test_spheres_that_overlap_where_the_links_do_not_are_no_contact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spheres: SphereSet
) -> None:
    desk = desk_of(tmp_path, monkeypatch, spheres, -OPEN, OPEN)
    found = judged(desk)
    assert found["outcome"] == "passed" and found["value"] == pytest.approx(0.022, abs=1e-4)


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
    found = judged(desk, *DRIVE)
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("self-collision margin: 20 mm")]
    assert len(said) == 1 and "block and drum" in said[0]
    if spheres is COVERING:  # its row stops the arm before the block, and the goal in it is not reached
        assert found["outcome"] == "passed" and desk.metrics()["goal_reached"] == 0
        assert "(their surfaces then" in said[0]
    else:  # no row knows of the blade
        assert (found["outcome"], found["label"]) == ("failed", "contact") and desk.metrics()["goal_reached"] == 1
        assert "(their spheres do not tell when their surfaces meet)" in said[0]


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
    assert apart.metrics()["goal_reached"] == 1 and apart.metrics()["num_relaxed"] == 0
    assert (found["outcome"], found["label"], found["who"]) == ("failed", "margin broken", "block and drum")
    assert 0 < found["value"] < found["threshold"] == pytest.approx(1e-3 * least, abs=1e-6)
    said = f"came together to {1e3 * found['value']:.1f} mm, in the recording {least} mm or more: their spheres keep"
    assert said in found["sentence"] and found["time_s"] > 0.5
    assert judged(apart)["outcome"] == judged(apart, *DRIVE)["outcome"] == "passed"
    as_near = desk_of(tmp_path / "as_near", monkeypatch, spheres, OPEN, there, urdf=urdf)
    assert judged(as_near, *DRIVE)["outcome"] == judged(as_near)["outcome"] == "passed"


def test_without_surfaces_spheres_that_a_lowered_margin_lets_come_together_are_not_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desk_of(tmp_path, monkeypatch, COVERING, OPEN, -OPEN, OPEN, urdf=LOST)
    found = judged(desk, *DRIVE, "--goal-joints=0.5,1.9")
    assert (found["outcome"], found["label"], found["who"]) == ("failed", "margin broken", "block and drum")
    assert desk.metrics()["num_relaxed"] == 0 and found["value"] < found["threshold"] - 0.001


def test_links_that_hardly_any_posture_parts_are_judged_where_the_recording_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, touching, inside = np.array([[0.0, 0.04], [0.0, 0.01], [0.0, -1.0]])
    desk = desk_of(tmp_path / "inside", monkeypatch, POST_SPHERES, inside, touching, urdf=POST)
    assert judged(desk) == {}
    said = "not judged whether they touch, for they overlap in every posture recorded or sampled: post and bob"
    assert said in capsys.readouterr().out
    found = judged(desk_of(tmp_path / "out", monkeypatch, POST_SPHERES, out, touching, urdf=POST))
    assert (found["outcome"], found["label"], found["who"]) == ("failed", "contact", "post and bob")
    assert said not in capsys.readouterr().out


def test_without_geometry_spheres_that_overlap_are_a_contact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = desk_of(tmp_path, monkeypatch, COVERING, OPEN, FOLDED)
    written(tmp_path, LOST)
    assert judged(desk)["label"] == "contact"
    assert judged(desk, "--mode", "closed-loop", "--set", "control.max_time=0.2")
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["about"]["self_margins"].count("mm") >= 2
