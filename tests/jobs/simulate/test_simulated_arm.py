"""``simulate --urdf``: a log of an arm with meshes, whose folder needs nothing else."""

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.config import fixed
from splatctrl_cli.errors import UsageError
from splatctrl_cli.formats.mesh import load_mesh
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, simulate
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import JointState, RgbdFrame
from splatctrl_cli.robot import sphere_fit
from splatctrl_cli.robot.link_meshes import MeshDistance
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_fit import FitOptions
from splatctrl_cli.robot.urdf import read_urdf, visual_urdf
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.recording import Recording, RecordingOptions
from splatctrl_cli.simulate.truth import distance_to, load_truth
from tests.jobs.bake.baked import Said
from tests.refused import expect_refusal
from tests.robot.shapes import collada, coverage_deficit, written

OPTIONS = RecordingOptions(duration_s=3.0, fps=1.0, width=64, height=48, noise="none", color_rays=0)
FINGERS = "".join(
    f'<link name="{side}"/><joint name="{side}_joint" type="prismatic"><parent link="hand"/><child link="{side}"/>'
    '<axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="1" effort="1"/></joint>'
    for side in ("left", "right")
)


@pytest.fixture(scope="module", autouse=True)
def few_turns(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Try few turns of the tip, and few patches for spheres, for speed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fixed, "SIMULATED_TURNS", 2)
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("fits")))
        patch.setattr(sphere_fit, "FitOptions", partial(FitOptions, restarts=1, num_patches=500, num_candidates=600))
        yield


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory, plain_arm: Path) -> Path:
    """The simulated arm of boxes, with other joint names, fingers that no log moves, and a mesh for its forearm."""
    folder = tmp_path_factory.mktemp("packages") / "my_arm"
    mesh = folder / "meshes" / "forearm.stl"
    mesh.parent.mkdir(parents=True)
    capsule = trimesh.creation.capsule(height=0.2, radius=0.055, count=[12, 12])
    capsule.apply_translation([0.0, 0.01, -0.22])
    capsule.export(mesh)
    text = (plain_arm / "tabletop" / "robot.urdf").read_text().replace('name="joint', 'name="my_joint')
    text = re.sub(r'<cylinder radius="(\S+)" length="(\S+)"/>', r'<box size="\1 \1 \2"/>', text)
    text = re.sub(r'<sphere radius="(\S+)"/>', r'<box size="\1 \1 \1"/>', text)
    before, link, after = text.partition('<link name="link5">')
    geometry = '<collision><geometry><mesh filename="package://my_arm/meshes/forearm.stl"/></geometry></collision>'
    text = before + link + geometry + after[after.index("</link>") :]
    return written(folder, text.replace("</robot>", f"{FINGERS}</robot>"), "my_arm.urdf")


@pytest.fixture(scope="module")
def simulated(arm: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "log"
    moved = shutil.copyfile(arm, tmp_path_factory.mktemp("elsewhere") / "arm.urdf")
    expect_refusal(
        r"package://my_arm/meshes/forearm\.stl was not found; .* --packages",
        simulate,
        SimulateRequest(out=out, urdf=moved, options=OPTIONS),
    )
    assert not out.exists()
    simulate(SimulateRequest(out=out, urdf=moved, packages=(arm.parents[1],), options=OPTIONS))
    return out


def test_the_folder_holds_the_arm_with_its_meshes_and_covering_spheres(simulated: Path) -> None:
    urdf = read_urdf(simulated / "robot.urdf")
    assert {mesh.filename for mesh in urdf.meshes} == {"meshes/forearm.stl"}
    model = RobotModel.from_urdf(simulated / "robot.urdf", simulated / "robot_spheres.yaml")
    assert coverage_deficit(urdf, model.sphere_set).max_deficit == 0.0
    truth = load_truth(simulated / "truth.json")
    assert truth.joint_names == tuple(f"my_joint{k}" for k in range(1, 8)) and truth.clearance.min() > 0.02


def test_every_depth_of_the_log_lies_on_the_arm_or_in_the_scene(simulated: Path) -> None:
    truth = load_truth(simulated / "truth.json")
    source = open_source(simulated / "log.mcap", SourceOptions())
    model = RobotModel.from_urdf(simulated / "robot.urdf", simulated / "robot_spheres.yaml")
    model = model.moved_by(source.joint_names)
    assert source.joint_names == truth.joint_names
    surface, q, on_mesh = model.surface, np.zeros(7), 0
    forearm = MeshDistance(load_mesh(simulated / "meshes" / "forearm.stl"))
    for record in source.records():
        if isinstance(record, JointState):
            q = record.position
            continue
        assert isinstance(record, RgbdFrame)
        points = back_project(record.intrinsics, record.depth)[record.depth > 0]
        points = transform_points(record.T_world_camera, points)
        poses = {link: model.frame_pose(q, link) for link in surface.links}
        to_scene = np.abs(distance_to(truth.primitives, points, record.stamp_ns))
        to_solids = np.abs(surface.distance(surface.poses(poses), points))
        to_mesh = np.abs(forearm.signed(transform_points(np.linalg.inv(poses["link5"]), points)))
        assert np.min([to_scene, to_solids, to_mesh], axis=0).max() < 2e-3  # depths of the log are in millimetres
        on_mesh += int(np.sum((to_mesh < 1e-3) & (to_scene > 0.01)))
    assert on_mesh > 20


def test_the_same_options_give_the_same_bytes(simulated: Path, arm: Path, tmp_path: Path) -> None:
    spheres = simulated / "robot_spheres.yaml"
    simulate(SimulateRequest(out=tmp_path / "again", urdf=arm, spheres=spheres, options=OPTIONS))
    for name in ("log.mcap", "truth.json", "robot.urdf"):
        assert (tmp_path / "again" / name).read_bytes() == (simulated / name).read_bytes(), name


def test_given_spheres_are_taken_and_the_same_kinematics_move_alike(
    arm: Path, simulated: Path, tmp_path: Path
) -> None:
    spheres = simulated / "robot_spheres.yaml"
    urdf, out = written(arm.parent, arm.read_text().replace(FINGERS, ""), "my_bare_arm.urdf"), tmp_path / "out"
    simulate(SimulateRequest(out=out, urdf=urdf, spheres=spheres, options=OPTIONS))
    assert (out / "robot_spheres.yaml").read_bytes() == spheres.read_bytes()
    source = open_source(out / "log.mcap", SourceOptions())
    moved = [record.position for record in source.records() if isinstance(record, JointState)]
    expected = [tabletop.arm_motion(OPTIONS.duration_s).at(index / 50)[0] for index in range(len(moved))]
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    expect_refusal("--spheres", SimulateRequest, out=tmp_path / "none", spheres=spheres, error=UsageError)


NAMES = ("visual/seen", "forearm")


@pytest.mark.parametrize("suffix", ["dae", "none"])
def test_a_link_is_seen_by_its_visual_mesh_where_that_can_be_read(
    arm: Path, simulated: Path, tmp_path: Path, suffix: str
) -> None:
    """The forearm's visual mesh is a rod of 3 cm inside of its collision mesh."""
    (urdf,) = shutil.copytree(arm.parents[1], tmp_path / "packages").rglob("my_arm.urdf")
    rod = trimesh.creation.capsule(height=0.2, radius=0.03, count=[16, 16])
    rod.apply_translation([0.0, 0.01, -0.22])
    if suffix == "dae":
        (urdf.parent / "meshes" / "seen.dae").write_text(collada(rod))
    visual = f'<visual><geometry><mesh filename="package://my_arm/meshes/seen.{suffix}"/></geometry></visual>'
    urdf.write_text(urdf.read_text().replace('<link name="link5">', f'<link name="link5">{visual}'))
    request = SimulateRequest(
        out=tmp_path / "out", urdf=urdf, spheres=simulated / "robot_spheres.yaml", options=OPTIONS
    )
    simulate(request, heard := Said())
    copy = read_urdf(tmp_path / "out" / "robot.urdf")
    assert {mesh.filename for mesh in copy.meshes} == {"meshes/forearm.stl"}
    seen = visual_urdf(copy)
    if suffix == "none":
        assert [mesh.filename for mesh in seen.meshes] == ["meshes/forearm.stl"]
        assert any("seen.none was not found; link 'link5' is seen by its collision" in line for line in heard.lines)
        return
    assert [mesh.filename for mesh in seen.meshes] == ["meshes/visual/seen.stl"]
    model = RobotModel.from_urdf(copy.path, tmp_path / "out" / "robot_spheres.yaml")
    model = model.moved_by([f"my_joint{k}" for k in range(1, 8)])
    seen_mesh, collides = (MeshDistance(load_mesh(copy.path.parent / f"meshes/{name}.stl")) for name in NAMES)
    recording = Recording(replace(OPTIONS, width=160, height=120), model)
    q, found = next(iter(recording.joint_states())).position, 0
    for frame in recording.frames_at(0, q):
        points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))[frame.depth > 0]
        points = transform_points(np.linalg.inv(model.frame_pose(q, "link5")), points)
        is_inside = collides.signed(points) < -0.01
        assert np.median(np.abs(seen_mesh.signed(points[is_inside]))) < 1e-3
        found += int(is_inside.sum())
    assert found > 30
