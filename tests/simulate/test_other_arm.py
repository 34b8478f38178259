"""Another arm in the scene: its meshes as cameras see them, and its tip where the simulated arm's hand goes."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.shared_workspace import scene_of
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.jobs.simulate.simulate import adapt_motion
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_margins import SelfSurfaces
from splatctrl_cli.robot.urdf import read_urdf
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.arm import hand_pose
from splatctrl_cli.simulate.primitives import Primitive, Texture
from splatctrl_cli.simulate.recording import Recording, RecordingOptions, Scene
from splatctrl_cli.simulate.render import Meshes, Renderer
from tests.refused import expect_refusal
from tests.robot.shapes import JOINTS, arm_of, ur10e_urdf, written
from tests.simulate.limits import DURATIONS, assert_keeps_limits

TEXTURE = Texture(pattern="noise", feature=0.05, dark=(0.1, 0.2, 0.3), bright=(0.9, 0.8, 0.7), seed=3)


@pytest.fixture(autouse=True)
def few_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turns of the tip that are tried, for speed."""
    monkeypatch.setattr(fixed, "SIMULATED_TURNS", 2)


def meshes(folder: Path, shape: str, T: Float64) -> Meshes:
    """Meshes of one link with a shape, at a pose."""
    (solid,) = read_solids(read_urdf(written(folder, arm_of(shape, '<sphere radius="0.1"/>'))))["base"]
    owners = np.zeros(len(solid.surface.faces), np.int16)
    return Meshes(
        links=("base",), triangles=solid.surface.corners, owners=owners, textures=(TEXTURE,), T_world_link=T[None]
    )


def test_a_mesh_is_seen_as_the_solid_of_the_same_shape(tmp_path: Path) -> None:
    T = pose_at([0.4, 0.0, 0.2], [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    box = Primitive(name="box", kind="box", size=(0.2, 0.3, 0.25), T_world_shape=T, texture=TEXTURE)
    mesh = meshes(tmp_path, '<box size="0.2 0.3 0.25"/>', np.eye(4)).at({"base": T})
    renderer = Renderer(tabletop.cameras(160, 120)[0], tabletop.furniture())
    color, depth = renderer.image([box])
    color_mesh, depth_mesh = renderer.image([], mesh)
    is_box = depth != renderer.depth([])
    assert 200 < is_box.sum() < 0.5 * is_box.size
    np.testing.assert_array_equal(depth_mesh != renderer.depth([]), is_box)
    np.testing.assert_allclose(depth_mesh, depth, atol=1e-5)
    assert np.abs(color_mesh.astype(int) - color.astype(int)).max() <= 1
    np.testing.assert_array_equal(renderer.depth([], mesh), depth_mesh)


def test_faces_beyond_what_16_bits_number_are_seen_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    mesh = meshes(tmp_path, '<sphere radius="0.2"/>', pose_at([0.4, 0.0, 0.2]))
    renderer = Renderer(tabletop.cameras(80, 60)[1], [])
    whole = renderer.image([], mesh)
    monkeypatch.setattr("splatctrl_cli.simulate.render.FACES_AT_ONCE", 100)
    for before, after in zip(whole, renderer.image([], mesh), strict=True):
        np.testing.assert_array_equal(before, after)


def test_the_hand_is_where_the_model_of_the_arm_has_it(plain_arm: Path) -> None:
    arm = RobotModel.from_urdf(plain_arm / "tabletop" / "robot.urdf", plain_arm / "tabletop" / "robot_spheres.yaml")
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (20, 7)):
        np.testing.assert_allclose(hand_pose(q), arm.frame_pose(q, "hand"), atol=1e-12)


def ur10e(folder: Path, text: str = "") -> RobotModel:
    """With a sphere at every link but the base."""
    links = tuple(joint[1] for joint in JOINTS)
    spheres = SphereSet(links=links, centers=np.zeros((len(links), 3)), radii=np.full(len(links), 0.06))
    return RobotModel.from_urdf(written(folder, text or ur10e_urdf()), spheres)


@pytest.mark.parametrize(
    ("scene", "duration", "turns"), [(Scene.of(RecordingOptions()), 7.0, 2), (scene_of("near-goal", 0), 24.0, 4)]
)
def test_an_arm_of_six_joints_goes_where_ours_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene: Scene, duration: float, turns: int
) -> None:
    monkeypatch.setattr(fixed, "SIMULATED_TURNS", turns)
    model = ur10e(tmp_path)
    motion = adapt_motion(scene, model, SelfSurfaces(model, {}))
    np.testing.assert_array_equal(motion.times, scene.motion.times)
    for ours, theirs in zip(scene.motion.waypoints, motion.waypoints, strict=True):
        hand, tip = hand_pose(ours), model.frame_pose(theirs, "tool0")
        np.testing.assert_allclose(tip[:3, 3], hand[:3, 3], atol=2e-3)
        assert tip[:3, 2] @ hand[:3, 2] > 0.999
    velocity = np.array([motion.at(second)[1] for second in np.linspace(0, duration, 200)])
    assert np.all(np.abs(velocity) <= model.velocity_limit)


def test_a_small_arm_goes_as_far_as_it_reaches_and_a_tiny_one_is_refused(tmp_path: Path) -> None:
    def scaled(by: float) -> str:
        text = ur10e_urdf()
        for _, _, xyz, *_ in JOINTS:
            shorter = " ".join(str(by * float(x)) for x in xyz.split())
            text = text.replace(f'xyz="{xyz}"', f'xyz="{shorter}"')
        return text

    scene = Scene.of(RecordingOptions(is_free=True))
    small = ur10e(tmp_path, scaled(0.45))
    motion = adapt_motion(scene, small, SelfSurfaces(small, {}))
    for ours, theirs in zip(scene.motion.waypoints, motion.waypoints, strict=True):
        hand, tip = hand_pose(ours)[:3, 3], small.frame_pose(theirs, "tool0")[:3, 3]
        assert tip[2] == pytest.approx(hand[2], abs=2e-3)
        assert np.linalg.norm(tip[:2]) < np.linalg.norm(hand[:2]) + 1e-3
        assert tip[0] * hand[1] - tip[1] * hand[0] == pytest.approx(0.0, abs=2e-3)
    tiny = ur10e(tmp_path, scaled(0.05))
    words = r"expected tool0 to reach .* pointing down, got no posture; give the URDF"
    expect_refusal(words, adapt_motion, scene, tiny, SelfSurfaces(tiny, {}))


def test_an_arm_goes_no_way_on_which_it_meets_itself(tmp_path: Path) -> None:
    model, scene = ur10e(tmp_path), Scene.of(RecordingOptions(is_free=True))
    motion = adapt_motion(scene, model, SelfSurfaces(model, {}))
    seconds = np.linspace(0, 7, 300)
    passed = motion.at(3.5)[0]

    class Meeting(SelfSurfaces):
        """Links overlap in every posture within a radius [rad] of one that was passed."""

        radius = 0.4

        def gaps(self, q: Float64, centers: Float64, enough: float) -> Float64:
            return np.asarray(np.linalg.norm(q - passed, axis=1, keepdims=True) - self.radius)

    meeting = Meeting(model, {})
    other = adapt_motion(scene, model, meeting)
    gaps = meeting.gaps(np.array([other.at(second)[0] for second in seconds]), np.zeros(0), 0.0)
    assert gaps.min() > -0.05 and not np.allclose(other.waypoints, motion.waypoints)
    Meeting.radius = 100.0
    expect_refusal("expected a way between the waypoints, got none", adapt_motion, scene, model, meeting)


@pytest.mark.parametrize("duration", DURATIONS[::2])
def test_another_arm_keeps_its_velocity_limits_in_any_time(tmp_path: Path, duration: float) -> None:
    model, options = ur10e(tmp_path), RecordingOptions(duration_s=duration, fps=10.0)
    scene = Scene.of(options)
    motion = adapt_motion(scene, model, SelfSurfaces(model, {}))
    recording = Recording(options, model, replace(scene, motion=motion))
    assert_keeps_limits(recording)
    assert recording.clearances()[1].min() > 0


def test_an_arm_that_is_too_slow_for_its_task_beside_a_person_is_refused(tmp_path: Path) -> None:
    slow = ur10e(tmp_path, re.sub(r'velocity="[^"]+"', 'velocity="0.2"', ur10e_urdf()))
    given = scene_of("near-goal", 0), slow, SelfSurfaces(slow, {})
    expect_refusal("expected a way between the waypoints, got none", adapt_motion, *given)


def test_free_space_has_floor_and_walls_alone() -> None:
    scene = Scene.of(RecordingOptions(is_free=True))
    assert {p.name for p in scene.primitives} == {"floor", "wall_back", "wall_left", "wall_right"}
    assert scene.temporary == ()
    expect_refusal("--free: expected no --person", RecordingOptions, is_free=True, with_person=True, error=UsageError)
