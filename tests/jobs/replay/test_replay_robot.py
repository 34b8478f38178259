"""What a replay says of the robot it was given, and that the size of its blocks of states changes nothing."""

import json
import re
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.replay import ReplayTask, closed_loop
from splatctrl_cli.files import spilled_rows
from splatctrl_cli.geometry import transform_points
from splatctrl_cli.jobs.replay import files, state_pass
from splatctrl_cli.jobs.replay.inputs import MeasuredRobot, doubts_of, measured_robot
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.recording.log import state_columns
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot import self_margins
from splatctrl_cli.robot.coverage import refine_triangles
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import spheres_yaml
from tests.cli.replay_desk import BALL, SECOND, START, Desk, logged, scene_of, splats_of, write_field, write_scene
from tests.control.fakes import Balls
from tests.jobs.stage import MOVE
from tests.robot.shapes import arm_of, coverage_deficit, l_shape, written

SHORT = 0.012  # [m] taken off every radius


def shrunk(spheres: SphereSet, links: tuple[str, ...] | None = None) -> SphereSet:
    """The set with smaller spheres, only those on `links`."""
    kept = [index for index, link in enumerate(spheres.links) if links is None or link in links]
    return SphereSet(
        links=tuple(spheres.links[index] for index in kept),
        centers=spheres.centers[kept],
        radii=spheres.radii[kept] - SHORT,
    )


def with_spheres(desk: Desk, spheres: SphereSet) -> Desk:
    path = desk.folder / "spheres.yaml"
    path.write_text(spheres_yaml(spheres))
    desk.robot[-1] = str(path)
    return desk


def about_of(desk: Desk, out: str = "out") -> dict[str, str]:
    return dict(desk.json("summary.json", out)["about"])


def surface_clearance(model: RobotModel, positions: Float64, field: Balls) -> float:
    """The least distance from points on the collision surface of the links that move, at most 2 cm apart."""
    least = np.inf
    for link, solids in read_solids(model.urdf).items():
        if link != "link0":
            points = np.concatenate([refine_triangles(s.surface.corners, 0.02).reshape(-1, 3)[::3] for s in solids])
            poses = [model.frame_pose(q, link) for q in positions]
            least = min(least, *(field.query(transform_points(pose, points))[0].min() for pose in poses))
    return float(least)


def test_a_replay_says_what_the_spheres_leave_uncovered(desk: Desk, arm: RobotModel) -> None:
    with_spheres(desk, shrunk(arm.sphere_set))
    assert desk.replay(*scene_of(desk, BALL), "-q") == 0
    report, told = coverage_deficit(arm.urdf, shrunk(arm.sphere_set)), about_of(desk)["coverage"]
    assert desk.metrics()["coverage_deficit"] == pytest.approx(report.max_deficit, abs=1e-9)
    proven = f"up to {1e3 * report.worst.deficit.proven:.2f} mm"  # type: ignore[union-attr]
    assert all(words in told for words in (report.worst.link, proven, "where they keep 20 mm the surface keeps"))


def bare(desk: Desk, arm: RobotModel) -> None:
    """No sphere on a fixed link, nor on one that moves."""
    links = tuple(link for link in dict.fromkeys(arm.sphere_set.links) if link not in ("link0", "link3"))
    with_spheres(desk, shrunk(arm.sphere_set, links))


def unreadable(desk: Desk, arm: RobotModel) -> None:
    """A collision mesh that is not there."""
    mesh = '<collision><geometry><mesh filename="package://arm/m.stl"/></geometry></collision>'
    text = Path(desk.robot[1]).read_text().replace('<link name="link1">', f'<link name="link1">{mesh}', 1)
    desk.robot[1] = str(written(desk.folder, text, "lost.urdf"))


@pytest.mark.parametrize(
    ("change", "told", "refusal"),
    [
        (
            bare,
            "nothing of link0, link3, which have no sphere",
            r"expected spheres on every link that moves, got none on link3[;\n].*splatctrl robot spheres",
        ),
        (
            unreadable,
            r"is not known.*package://arm/m\.stl",
            "with --packages DIR; or set control.coverage = report",
        ),
    ],
)
def test_what_no_deficit_is_known_of_is_named_and_refused_as_a_margin(
    desk: Desk,
    arm: RobotModel,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Desk, RobotModel], None],
    told: str,
    refusal: str,
) -> None:
    scene = scene_of(desk, BALL)
    change(desk, arm)
    assert desk.replay(*scene, "-q") == 0 and desk.metrics()["coverage_deficit"] is None
    assert re.search(told, about_of(desk)["coverage"])
    assert desk.replay(*scene, "-q", "--force", "--set", "control.coverage=margin") == 4
    assert re.search(refusal, capsys.readouterr().err, flags=re.DOTALL)


def test_with_the_deficit_in_the_rows_the_surface_keeps_the_margin(arm: RobotModel, plain_arm: Path) -> None:
    spheres = shrunk(arm.sphere_set)
    model = RobotModel.from_urdf(plain_arm / "tabletop" / "robot.urdf", spheres)
    model = model.replace_coverage(coverage_deficit(model.urdf, spheres))
    ball, frame = Balls([BALL[0]], [BALL[1]]), model.frame_names[-1]
    goal = model.frame_pose(START, frame)
    goal[:3, 3] = np.array(BALL[0]) - [0.02, 0.02, 0.0]
    task = ReplayTask(start=START, T_world_goal=goal, frame=frame)
    kept = {}
    for coverage in ("report", "margin"):
        config = ControlConfig(coverage=coverage, solver="daqp", max_time=6.0)
        trace = closed_loop(model, config, task, lambda stamp: ball)
        kept[coverage] = surface_clearance(model, trace.position[:: len(trace.position) // 4], ball)
    assert kept["margin"] >= 0.02 - 1e-3 and kept["report"] < 0.02 - 3e-3


def test_spheres_that_stick_out_of_a_drawn_link_into_the_margin_are_named(desk: Desk, arm: RobotModel) -> None:
    drawn, place = desk.folder / "drawn.urdf", arm.frame_pose(START, "hand")
    trimesh.creation.icosphere(radius=0.01).export(desk.folder / "palm.stl")
    before, name, after = Path(desk.robot[1]).read_text().partition('<link name="hand">')
    own, end, rest = after.partition("</link>")
    own = re.sub("<visual>.*?</visual>", "", own, flags=re.DOTALL)
    palm = '<visual><geometry><mesh filename="palm.stl"/></geometry></visual>'
    text = before + name + palm + own + end + rest
    drawn.write_text(re.sub('velocity="[0-9.]*"', 'velocity="0.001"', text))  # too slow to retreat
    desk.robot[1] = str(drawn)
    mine = np.array([link == "hand" for link in arm.sphere_set.links])
    tips = arm.sphere_set.centers[mine, 2] + arm.sphere_set.radii[mine]
    ball = (tuple((place @ [*arm.sphere_set.centers[mine][tips.argmax()][:2], tips.max() + 0.06, 1.0])[:3]), 0.05)
    assert desk.replay(*scene_of(desk, ball), "--mode", "closed-loop", "-q") == 0  # type: ignore[arg-type]
    told = about_of(desk)["by_surface"]
    assert re.fullmatch(r"[1-9] spheres come within the margin, but their links' surfaces do not: of hand", told)
    assert desk.metrics()["num_relaxed"] == 0
    field = write_field(desk.folder / "field", ball)  # type: ignore[arg-type]
    assert desk.replay("--field", str(field), "--mode", "closed-loop", "-q", out="grid") == 0
    assert "by_surface" not in about_of(desk, "grid")


def test_pairs_that_an_srdf_disables_have_no_row(desk: Desk, arm: RobotModel) -> None:
    scene, pairs = scene_of(desk, BALL), arm.self_pairs()
    links = [arm.sphere_set.links[s] for s in pairs[0]]
    disabled = f'<disable_collisions link1="{links[1]}" link2="{links[0]}" reason="Never"/>'
    srdf = written(desk.folder, f'<robot name="arm">{disabled}</robot>', "arm.srdf")
    assert desk.replay(*scene, "-q") == 0 and desk.metrics()["num_self_pairs"] == len(pairs)
    gone = sum({arm.sphere_set.links[a], arm.sphere_set.links[b]} == set(links) for a, b in pairs)
    assert desk.replay(*scene, "-q", "--force", "--srdf", str(srdf)) == 0
    assert gone > 0 and desk.metrics()["num_self_pairs"] == len(pairs) - gone
    assert srdf.name in desk.json("run.json")["inputs"]


@pytest.mark.usefixtures("painted")
def test_an_fr3_is_reminded_of_its_limits_by_position(plain_arm: Path, tmp_path: Path) -> None:
    tabletop = plain_arm / "tabletop"
    text = (tabletop / "robot.urdf").read_text().replace('joint name="joint', 'joint name="fr3_joint')
    model = RobotModel.from_urdf(written(tmp_path, text, "fr3.urdf"), tabletop / "robot_spheres.yaml")
    robot = MeasuredRobot(model=model, surfaces=None)
    doubts = [
        doubts_of(Namespace(mode=mode), robot, ControlConfig(velocity_limits=limits))
        for mode, limits in (("closed-loop", "urdf"), ("closed-loop", "fr3"), ("audit", "urdf"))
    ]
    assert [len(each) for each in doubts] == [1, 0, 0] and "control.velocity_limits = fr3" in doubts[0][0]


def test_a_margin_that_spheres_cannot_keep_is_lowered_and_said_once(
    desk: Desk, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(self_margins, "SELF_POSTURES", 100)
    drive = (*scene_of(desk, BALL), "--force", "--set", "control.solver=daqp", "--set", "control.max_time=0.1")
    wide = ("--set", "control.self_margin=0.06")
    for options, said in (("--mode=closed-loop", 0), (("--mode=closed-loop", *wide), 1), (wide, 0)):
        assert desk.replay(*drive, *([options] if isinstance(options, str) else options)) == 0
        told = capsys.readouterr()
        lines = [line for line in (told.out + told.err).splitlines() if "self-collision margin" in line]
        assert len(lines) == said
    assert desk.replay(*drive, "--mode=closed-loop", *wide) == 0
    assert re.fullmatch(
        "self-collision margin: 60 mm, but of pairs with near spheres .*link5 and link7.*"
        "contact is judged by surfaces",
        about_of(desk)["self_margins"],
    )


def test_a_replay_finds_the_meshes_of_the_self_mask_where_its_packages_are(tmp_path: Path) -> None:
    mesh = tmp_path / "elsewhere" / "far" / "ell.stl"
    mesh.parent.mkdir(parents=True)
    l_shape().export(mesh)
    urdf = written(tmp_path / "robot", arm_of('<mesh filename="package://far/ell.stl"/>', '<sphere radius="0.02"/>'))
    spheres = SphereSet(links=("base", "tip"), centers=np.zeros((2, 3)), radii=np.full(2, 0.3))
    file = written(tmp_path, spheres_yaml(spheres, ()), "spheres.yaml")
    for packages, missing in (((), ("base",)), ((tmp_path / "elsewhere",), ())):
        request = ReplayRequest(log=tmp_path, out=tmp_path, urdf=urdf, spheres=file, packages=packages)
        model = RobotModel.from_urdf(urdf, file, packages=packages)
        assert measured_robot(request, model, ControlConfig()).model.surface.by_spheres == missing


FILES = ("steps.csv", "events.json", "summary.json", "states.json")


@pytest.mark.parametrize("mode", ["audit", "open-loop", "closed-loop"])
def test_blocks_of_any_size_give_the_same_files(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, sample_data: Path, mode: str
) -> None:
    desk.source.states = [replace(s, velocity=MOVE) for s in logged(START + MOVE, num=13)]
    both = splats_of(BALL, ((0.45, 0.1, 0.6), 0.05))
    snapshots = ((SECOND // 5, splats_of(BALL)), (SECOND // 2, both), (SECOND, splats_of(BALL)))
    scene = write_scene(desk.folder / "scene", *snapshots)
    document = json.loads((sample_data / "tabletop" / "truth.json").read_text())
    stamps = [state.stamp_ns for state in desk.source.states]
    document["clearance"] |= {"stamps": stamps, "distance": [0.0] * len(stamps)}
    (desk.folder / "truth.json").write_text(json.dumps(document))
    truth = ("--truth", str(desk.folder / "truth.json"))
    more = {"audit": truth, "open-loop": (), "closed-loop": ("--follow",)}[mode]
    for num in (1, 7, 10_000):
        for module in (files, state_pass, spilled_rows, state_columns):
            monkeypatch.setattr(module, "BLOCK", num)
        assert desk.replay("--scene", str(scene), "-q", "--mode", mode, *more, out=str(num)) == 0
    for file in FILES:
        whole = (desk.folder / "10000" / file).read_bytes()
        assert all((desk.folder / out / file).read_bytes() == whole for out in ("1", "7")), file


def test_stored_objects_are_those_of_a_list_over_the_borders_of_blocks() -> None:
    stored: spilled_rows.ObjectFile[int] = spilled_rows.ObjectFile()
    for block in ([0, 1], [], [2, 3, 4], [5]):
        stored.extend(block)
    whole = list(range(6))
    assert list(stored) == whole and stored[-1] == 5 and stored[4:1:-1] == whole[4:1:-1]
    assert all(stored[i:j] == whole[i:j] for i in range(-7, 8) for j in range(-7, 8))


def test_a_row_per_step_with_nothing_where_there_is_no_value(tmp_path: Path) -> None:
    columns = {"stamp_ns": [1, 2], "d": [np.float64(0.123456789012), float("nan")], "name": ["a[0]", "b; c"]}
    files.write_steps(tmp_path / "steps.csv", [columns])
    assert (tmp_path / "steps.csv").read_text() == "stamp_ns,d,name\n1,0.123456789,a[0]\n2,,b; c\n"


def test_columns_of_unequal_length_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shorter"):
        files.write_steps(tmp_path / "steps.csv", [{"a": [1, 2], "b": [1]}])
