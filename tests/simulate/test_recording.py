"""The recording: images that agree with the truth, noise as stated, motion within limits, truth that reads back."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.formats.mesh import load_mesh
from splatctrl_cli.geometry import back_project, pose_at, transform_points
from splatctrl_cli.records import Float64, JointState, RgbdFrame
from splatctrl_cli.robot.coverage import coverage_of_solids
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.arm import UNMODELLED, Motion, link_shape
from splatctrl_cli.simulate.primitives import Primitive, Texture, luminance_std
from splatctrl_cli.simulate.recording import Recording, RecordingOptions
from splatctrl_cli.simulate.render import Renderer
from splatctrl_cli.simulate.truth import Truth, closest_of, distance_to, load_truth, truth_document
from tests.refused import expect_refusal
from tests.simulate.limits import DURATIONS, assert_keeps_limits

SMALL = {"duration_s": 3.0, "fps": 1.0, "width": 80, "height": 60}


@pytest.fixture(scope="module")
def robot(plain_arm: Path) -> RobotModel:
    return RobotModel.from_urdf(plain_arm / "tabletop" / "robot.urdf", plain_arm / "tabletop" / "robot_spheres.yaml")


@pytest.fixture(scope="module")
def exact(robot: RobotModel) -> Recording:
    return Recording(RecordingOptions(noise="none", **SMALL), robot)


@pytest.fixture(scope="module")
def frames(exact: Recording) -> list[RgbdFrame]:
    return list(exact.frames())


def solids_at(recording: Recording, frame: RgbdFrame) -> list[Primitive]:
    """Everything there, the arm's shapes too."""
    states = {state.stamp_ns: state for state in recording.joint_states()}
    links = recording.link_poses(states[frame.stamp_ns].position)
    present = [p for p in recording.primitives if p.is_present(frame.stamp_ns)]
    return present + tabletop.arm_solids(recording.robot.urdf.shapes, links)


def test_every_exact_depth_lies_on_a_surface_before_which_nothing_stands(
    exact: Recording, frames: list[RgbdFrame]
) -> None:
    for frame in frames:
        points = back_project(frame.intrinsics, frame.depth)[frame.depth > 0]
        assert frame.human is None and (frame.depth > 0).mean() > 0.98
        T, solids = frame.T_world_camera, solids_at(exact, frame)
        at, before = (
            distance_to(solids, transform_points(T, share * points), frame.stamp_ns) for share in (1.0, 0.98)
        )
        assert np.abs(at).max() < 1e-5  # float32 depth at 3 m
        assert before.min() > 0


def test_the_window_of_a_solid_loses_no_pixel(exact: Recording) -> None:
    camera, scene = exact.cameras[0], tabletop.objects()
    whole, apart = Renderer(camera, [*scene]).image([]), Renderer(camera, []).image(scene)
    np.testing.assert_array_equal(whole[0], apart[0])
    np.testing.assert_array_equal(whole[1], apart[1])
    behind = pose_at(camera.T_world_camera[:3, 3] - camera.T_world_camera[:3, 2])
    hidden = Primitive(name="far", kind="sphere", size=(0.1,), T_world_shape=behind, texture=scene[0].texture)
    np.testing.assert_array_equal(Renderer(camera, scene).image([hidden])[1], whole[1])


def test_the_visitor_comes_after_a_third_and_leaves_after_two(exact: Recording) -> None:
    middle = exact.primitives[-1].T_world_shape[None, :3, 3]
    stamps = [exact.start_ns + int(second * 1e9) for second in (0.9, 1.1, 1.9, 2.1)]
    inside = [bool(distance_to(exact.primitives, middle, stamp)[0] < 0) for stamp in stamps]
    assert inside == [False, True, True, False]


def test_the_visitor_stands_where_it_is_asked_to(robot: RobotModel) -> None:
    asked, plain = (
        Recording(options, robot).primitives
        for options in (RecordingOptions(visitor=(0.5, -0.1, 0.09)), RecordingOptions())
    )
    assert (asked[-1].T_world_shape[:3, 3].tolist(), asked[-1].size) == ([0.5, -0.1, 0.15], (0.09, 0.30))
    assert [p.name for p in asked] == [p.name for p in plain]


def test_training_images_have_contrast_and_the_arm_is_in_sight(exact: Recording, frames: list[RgbdFrame]) -> None:
    still = {camera.name: Renderer(camera, exact.primitives[:-1]).image([])[1] for camera in exact.cameras}
    for frame in frames:
        assert luminance_std(frame.color) >= 0.15, frame.camera
        assert (frame.depth < still[frame.camera] - 0.01).mean() > 0.02, frame.camera


def test_records_come_in_time_order_with_joint_states_first(exact: Recording) -> None:
    records = list(exact.records())
    keys = [(record.stamp_ns, isinstance(record, RgbdFrame)) for record in records]
    assert keys == sorted(keys)
    assert sum(isinstance(record, JointState) for record in records) == 151
    assert sum(isinstance(record, RgbdFrame) for record in records) == 12


def test_the_arm_moves_within_its_limits_and_its_velocity_is_the_slope(robot: RobotModel) -> None:
    motion = tabletop.arm_motion(7.0)
    for time in np.linspace(0.0, 7.0, 141):
        position, velocity = motion.at(time)
        slope = (motion.at(time + 1e-6)[0] - motion.at(time - 1e-6)[0]) / 2e-6
        np.testing.assert_allclose(velocity, slope, atol=1e-5)
        assert np.all((position > robot.lower) & (position < robot.upper))
        assert np.all(np.abs(velocity) < robot.velocity_limit)
    start, end = (robot.frame_pose(motion.at(t)[0], "hand")[:3, 3] for t in (0.0, 7.0))
    assert np.linalg.norm(end - start) > 0.5


@pytest.mark.parametrize("duration", DURATIONS)
def test_a_log_keeps_the_velocity_limits_in_any_time(robot: RobotModel, duration: float) -> None:
    assert_keeps_limits(Recording(RecordingOptions(duration_s=duration, fps=10.0), robot))


def test_a_motion_with_time_enough_stays_as_it_is_and_one_without_goes_the_same_way(robot: RobotModel) -> None:
    whole, short = tabletop.arm_motion(7.0), tabletop.arm_motion(0.5)
    assert whole.within(robot.velocity_limit).times.tobytes() == whole.times.tobytes()
    slowed = short.within(robot.velocity_limit)
    assert slowed.waypoints is short.waypoints and slowed.times[0] == short.times[0]
    seconds = np.linspace(slowed.times[0], slowed.times[-1], 2001)
    shares = np.abs([slowed.at(second)[1] for second in seconds]) / robot.velocity_limit
    assert shares.max() == pytest.approx(1.0, abs=1e-4)


def test_motion_rests_at_its_waypoints() -> None:
    motion = Motion(times=np.array([0.0, 1.0, 3.0]), waypoints=np.array([[0.0], [1.0], [-1.0]]))
    for time, waypoint in ((-1.0, 0.0), (0.0, 0.0), (1.0, 1.0), (3.0, -1.0), (9.0, -1.0)):
        position, velocity = motion.at(time)
        assert (position[0], velocity[0]) == pytest.approx((waypoint, 0.0))
    assert motion.at(2.0)[0][0] == pytest.approx(0.0)


def test_the_same_seed_gives_the_same_images_and_another_seed_others(robot: RobotModel) -> None:
    depth = [next(iter(Recording(RecordingOptions(seed=seed, **SMALL), robot).frames())).depth for seed in (1, 1, 2)]
    np.testing.assert_array_equal(depth[0], depth[1])
    assert (depth[0] != depth[2]).any()


def least(recording: Recording) -> tuple[float, int, Float64]:
    """The least true clearance, its stamp, and the posture there."""
    stamps, clearance = recording.clearances()
    index = int(np.argmin(clearance))
    return float(clearance[index]), int(stamps[index]), list(recording.joint_states())[index].position


def test_clearance_is_that_of_the_nearest_moving_sphere(exact: Recording) -> None:
    found, stamp, q = least(exact)
    moving = exact.robot.moving_spheres
    by_hand = distance_to(exact.primitives, exact.robot.sphere_centers(q)[moving], stamp)
    assert 0.03 < found < 0.10 and found == np.min(by_hand - exact.robot.sphere_set.radii[moving])


@pytest.mark.parametrize("pattern", ["noise", "stripes", "checks"])
def test_textures_stay_between_their_colours_and_are_smooth(pattern: str) -> None:
    texture = Texture(pattern=pattern, feature=0.1, dark=(0.1, 0.2, 0.3), bright=(0.9, 0.8, 0.7), seed=3)
    points = np.random.default_rng(0).uniform(-2, 2, (20_000, 3))
    color = texture.color(points)
    assert (np.clip(color, np.array(texture.dark) - 1e-12, np.array(texture.bright) + 1e-12) == color).all()
    assert color[:, 0].std() > 0.15
    assert np.abs(texture.color(points + 1e-5) - color).max() < 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"duration_s": 0.1}, "--duration: expected 0.5 to 600 s, got 0.1"),
        ({"fps": 0.0}, "--fps: expected up to 60"),
        ({"duration_s": float("nan")}, "--duration"),
        ({"width": 8}, "--width: expected 16 to 4096 px, got 8"),
        ({"noise": "loud"}, "--noise: expected one of none, realsense, stereo, got loud"),
        ({"seed": -1}, "--seed"),
        ({"visitor": (0.4, 0.1)}, "--visitor: expected X,Y within 5 m and RADIUS from 0.001 to 1 m, got 0.4,0.1"),
        ({"visitor": (0.4, 0.1, 0.0)}, "--visitor: expected X,Y"),
        ({"visitor": (0.4, 0.1, 0.1), "is_free": True}, "--visitor: expected no --person"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], message: str) -> None:
    expect_refusal(message, RecordingOptions, error=UsageError, **options)


def truth_of(recording: Recording, path: Path) -> Truth:
    stamps, clearance = recording.clearances()
    return Truth(
        path=path,
        primitives=recording.primitives,
        cameras=recording.cameras,
        luminance_std={camera.name: 0.2 for camera in recording.cameras},
        joint_names=recording.robot.joint_names,
        robot_urdf=path.parent / "robot.urdf",
        robot_spheres=path.parent / "robot_spheres.yaml",
        T_world_base=np.eye(4),
        stamps=stamps,
        clearance=clearance,
    )


def test_truth_reads_back_and_measures_the_same(exact: Recording, tmp_path: Path) -> None:
    truth = truth_of(exact, tmp_path / "truth.json")
    truth.path.write_text(json.dumps(truth_document(truth)))
    found = load_truth(truth.path)
    points = np.random.default_rng(0).uniform(-0.5, 1.0, (200, 3))
    for stamp in (exact.start_ns, exact.start_ns + 1_500_000_000):
        np.testing.assert_array_equal(found.distance(points, stamp), truth.distance(points, stamp))
    assert [p.name for p in found.primitives] == [p.name for p in truth.primitives]
    assert [(c.name, c.is_training) for c in found.cameras] == [(f"cam{i}", i < 3) for i in range(4)]
    assert (found.robot_urdf, found.stamps.tolist()) == (tmp_path / "robot.urdf", truth.stamps.tolist())
    np.testing.assert_allclose(found.clearance, truth.clearance, atol=1e-6)


def test_closest_surface_points_are_at_the_distance(exact: Recording) -> None:
    points = np.random.default_rng(0).uniform([0, -0.5, 0.01], [1.0, 0.5, 0.6], (500, 3))
    distance, surface = closest_of(exact.primitives, points, exact.start_ns)
    np.testing.assert_allclose(np.linalg.norm(points - surface, axis=1), np.abs(distance), atol=1e-12)
    each = np.array([closest_of([p], points, exact.start_ns)[0] for p in exact.primitives])
    np.testing.assert_array_equal(distance, each.min(axis=0))
    distance, surface = closest_of([exact.primitives[-1]], points, exact.start_ns)  # who comes later
    assert np.isinf(distance).all() and np.isnan(surface).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "No such file"),
        ("{", "not valid JSON"),
        ("[]", "expected splatctrl-truth version 1 or 2"),
        ('{"format": "splatctrl-truth", "version": 3}', "expected splatctrl-truth version 1 or 2"),
        ('{"format": "splatctrl-truth", "version": 1}', "damaged: KeyError"),
    ],
)
def test_what_is_no_truth_file_is_refused(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "truth.json").write_text(text)
    expect_refusal(message, load_truth, tmp_path / "truth.json")


def test_the_sample_keeps_its_promises(sample_data: Path) -> None:
    folder = sample_data / "tabletop"
    truth = load_truth(folder / "truth.json")
    assert truth.robot_urdf.is_file() and truth.robot_spheres.is_file()
    assert all(truth.luminance_std[camera.name] >= 0.15 for camera in truth.cameras if camera.is_training)
    assert 0.03 < truth.clearance.min() < 0.05
    assert sum(path.stat().st_size for path in sample_data.rglob("*") if path.is_file()) < 10e6
    robot = RobotModel.from_urdf(truth.robot_urdf, truth.robot_spheres).moved_by(truth.joint_names)
    assert all((folder / mesh.filename).is_file() for mesh in robot.urdf.meshes)
    solids = read_solids(robot.urdf)
    assert coverage_of_solids(robot.urdf, solids, robot.sphere_set, resolution=0.02).max_deficit == 0.0
    assert {"LICENSE", "NOTICE"} <= {path.name for path in (folder / "meshes").iterdir()}
    seen = [load_mesh(path) for path in (folder / "meshes" / "visual").iterdir()]
    assert len(seen) == 10 and max(len(mesh.faces) for mesh in seen) <= 2000


def test_a_person_walks_by_and_the_masks_show_where(robot: RobotModel) -> None:
    recording = Recording(RecordingOptions(noise="none", with_person=True, **SMALL | {"fps": 3.0}), robot)
    people = [p for p in recording.primitives if p.name.startswith("person")]
    places = []
    for frame in recording.frames():
        here = [p for p in people if p.is_present(frame.stamp_ns)]
        is_shown = frame.human > 0
        assert is_shown.any() == bool(here)
        points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))
        if here:
            distance = distance_to(here, points.reshape(-1, 3), frame.stamp_ns).reshape(is_shown.shape)
            assert ((np.abs(distance) < 1e-5) >= is_shown).all()
            assert is_shown[distance < -1e-5].all()
            places.append(float(here[0].T_world_shape[0, 3]))
    assert (len(set(places)), places) == (3, sorted(places, reverse=True))


def test_fewer_rays_change_colours_alone(exact: Recording) -> None:
    few, many = (Renderer(exact.cameras[0], tabletop.objects(), color_rays=num) for num in (0, 4))
    moving = [tabletop.visitor(0, 1)]
    np.testing.assert_array_equal(few.image(moving)[1], many.image(moving)[1])
    np.testing.assert_array_equal(few.depth(moving), many.image(moving)[1])
    assert 0 < np.abs(few.image(moving)[0].astype(float) - many.image(moving)[0]).mean() < 10


@pytest.mark.parametrize("name", UNMODELLED)
def test_an_unmodelled_part_is_in_the_images_and_the_truth_and_not_in_the_robot(robot: RobotModel, name: str) -> None:
    options = RecordingOptions(noise="none", **SMALL | {"width": 160, "height": 120, "duration_s": 1.0, "fps": 3.0})
    plain, more = Recording(options, robot), Recording(options, robot, unmodelled=(name,))
    q = np.array([0.8, -0.3, 0.0, -2.4, 0.0, 2.0, 0.8])
    link, capsules = UNMODELLED[name]
    part = tabletop.arm_solids([link_shape(link, capsule) for capsule in capsules], more.link_poses(q))
    differs = 0
    for before, after in zip(plain.frames_at(0, q), more.frames_at(0, q), strict=True):
        is_part = before.depth != after.depth
        points = transform_points(after.T_world_camera, back_project(after.intrinsics, after.depth))[is_part]
        assert len(points) == 0 or np.abs(distance_to(part, points, 0)).max() < 1e-5
        differs += int(is_part.sum())
    assert differs > 30 and more.robot is robot
    assert np.all(more.clearances()[1] <= plain.clearances()[1])


def test_the_true_clearance_of_a_part_is_its_own_to_a_millimetre(robot: RobotModel, exact: Recording) -> None:
    recording = Recording(RecordingOptions(**SMALL), robot, unmodelled=("tool",))
    found, stamp, q = least(recording)
    (tool,) = UNMODELLED["tool"][1]
    axis = transform_points(robot.frame_pose(q, "hand"), np.linspace(tool.start, tool.end, 1000))
    expected = distance_to(recording.primitives, axis, stamp).min() - tool.radius
    assert expected <= found < expected + 1e-3
    assert found < exact.clearances()[1].min() - 0.01
