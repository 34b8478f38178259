"""RobotModel: kinematics against published poses and finite differences, files that must and must not load."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio
import pytest

from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Box
from splatctrl_cli.robot.model import RobotModel
from tests.refused import expect_refusal
from tests.robot.shapes import written

READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
T_WORLD_BASE = look_at([0.3, -0.2, 0.1], [1.0, 2.0, 3.0])
PRISMATIC = """<robot name="rail"><link name="a"><collision><geometry><sphere radius="0.1"/></geometry></collision>
</link><link name="b"><collision><geometry><sphere radius="0.2"/></geometry></collision></link>
<joint name="turn" type="continuous"><parent link="a"/><child link="m"/><axis xyz="0 0 1"/></joint><link name="m"/>
<joint name="slide" type="prismatic"><origin xyz="0 0 1"/><parent link="m"/><child link="b"/><axis xyz="1 0 0"/>
<limit lower="-0.5" upper="2" velocity="1" effort="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def arm_files(plain_arm: Path) -> tuple[Path, Path]:
    return plain_arm / "tabletop" / "robot.urdf", plain_arm / "tabletop" / "robot_spheres.yaml"


@pytest.fixture(scope="module")
def arm(arm_files: tuple[Path, Path]) -> RobotModel:
    return RobotModel.from_urdf(*arm_files, T_world_base=T_WORLD_BASE)


def test_ready_posture_puts_the_flange_where_the_maker_publishes_it(arm_files: tuple[Path, Path]) -> None:
    pose = RobotModel.from_urdf(*arm_files).frame_pose(READY, "hand")
    np.testing.assert_allclose(pose[:3, 3], [0.30689, 0.0, 0.59028], atol=1e-5)
    np.testing.assert_allclose(pose[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-9)


def test_sphere_jacobians_agree_with_finite_differences(arm: RobotModel) -> None:
    q, step = READY + 0.1, 1e-6
    numeric = np.stack(
        [(arm.sphere_centers(q + step * e) - arm.sphere_centers(q - step * e)) / (2 * step) for e in np.eye(7)], -1
    )
    np.testing.assert_allclose(arm.spheres_at(q)[1], numeric, atol=1e-8)


def test_spheres_of_the_base_and_on_the_first_axis_do_not_move(arm: RobotModel) -> None:
    links = np.array(arm.sphere_set.links)
    centers = arm.sphere_set.centers
    on_axis = (links == "link1") & (np.linalg.norm(centers[:, :2], axis=1) < 1e-12)
    at_shoulder = (links == "link2") & (np.linalg.norm(centers, axis=1) < 1e-12)
    assert on_axis.any()
    np.testing.assert_array_equal(arm.moving_spheres, (links != "link0") & ~on_axis & ~at_shoulder)


def test_no_posture_leaves_the_reach(arm: RobotModel) -> None:
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (200, 7))
    far = np.linalg.norm(arm.sphere_centers_batch(postures) - arm.base_position, axis=2) + arm.sphere_set.radii
    assert 0.7 * arm.reach() < far.max() <= arm.reach()


def test_self_pairs_are_apart_on_bodies_that_are_not_neighbours(arm: RobotModel) -> None:
    pairs = arm.self_pairs(READY, touching=0.01)
    body = np.array([8 if link == "hand" else int(link[4:]) for link in arm.sphere_set.links])
    body[body == 8] = 7
    steps = np.abs(body[pairs[:, 0]] - body[pairs[:, 1]])
    centers, radii = arm.sphere_centers(READY), arm.sphere_set.radii
    gap = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1) - radii[pairs].sum(axis=1)
    assert len(pairs) > 100
    assert steps.min() == 2
    assert gap.min() > 0.01


def test_joint_order_sorts_a_log_into_the_model(arm: RobotModel) -> None:
    log = ["gripper", *reversed(arm.joint_names)]
    np.testing.assert_array_equal(np.array(log)[arm.joint_columns(log)[0]], arm.joint_names)


def test_continuous_and_prismatic_joints_take_one_number_each_and_a_locked_one_none(tmp_path: Path) -> None:
    rail = RobotModel.from_urdf(written(tmp_path, PRISMATIC))
    assert rail.joint_names == ("turn", "slide")
    np.testing.assert_array_equal(rail.lower, [-np.inf, -0.5])
    np.testing.assert_allclose(rail.sphere_centers(np.array([np.pi / 2, 1.5]))[1], [0, 1.5, 1], atol=1e-12)
    assert rail.reach() == pytest.approx(1 + 2 + 0.2)
    locked = RobotModel.from_urdf(tmp_path / "robot.urdf", locked={"slide": 0.25})
    assert locked.joint_names == ("turn",)
    np.testing.assert_allclose(locked.sphere_centers(np.array([0.0]))[1], [0.25, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "none.urdf.*No such file"),
        ("no xml", "robot.urdf.*broken XML"),
        ("<sdf/>", "expected a URDF with root <robot>, got <sdf>"),
        ('<robot name="x"><link name="a"/></robot>', "expected movable joints, got none; an unexpanded xacro"),
        (PRISMATIC.replace('child link="b"', 'child link="c"'), "joint 'slide': child link 'c' does not exist"),
        (PRISMATIC.replace('<link name="m"/>', '<link name="m"/><link name="z"/>'), "one root link, got a, z"),
        (PRISMATIC.replace('radius="0.2"', 'radius="-1"'), "link 'b': sphere: expected sizes above 0"),
        (PRISMATIC.replace('radius="0.2"', 'radius="wide"'), "link 'b': sphere: expected 1 number, got 'wide'"),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>', "broken XML"),
        (PRISMATIC.replace("collision>", "visual>"), "expected collision geometry, got none"),
    ],
)
def test_unusable_urdfs_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    written(tmp_path, text)
    assert ".urdf" in expect_refusal(
        message, RobotModel.from_urdf, tmp_path / ("robot.urdf" if text else "none.urdf")
    )


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (lambda arm: arm.sphere_centers(np.zeros(6)), r"joint positions: expected shape \(7,\), got \(6,\)"),
        (lambda arm: arm.sphere_centers_batch(np.zeros((7, 2))), r"expected shape \(T, 7\), got \(7, 2\)"),
        (lambda arm: arm.frame_pose(READY, "tool"), "no frame 'tool'; frames there: link0, "),
        (
            lambda arm: arm.joint_columns(arm.joint_names[:6]),
            "joints not in the log: joint7; the log has: .*--lock joint7=VALUE",
        ),
    ],
)
def test_postures_of_the_wrong_length_and_what_is_not_there_are_refused(
    arm: RobotModel, asked: Callable[[RobotModel], object], words: str
) -> None:
    expect_refusal(words, asked, arm)


def test_a_real_spherized_urdf_brings_its_own_spheres(real_data: Path) -> None:
    panda = RobotModel.from_urdf(real_data / "vamp_panda/resources/panda/panda_spherized.urdf")
    assert len(panda.sphere_set.radii) == 59
    np.testing.assert_allclose(panda.frame_pose(READY, "panda_hand")[:3, 3], [0.30689, 0, 0.59028], atol=1e-5)


def test_a_sphere_set_for_a_sister_robot_fits_by_link_number(real_data: Path) -> None:
    yaml = real_data / "robot_spheres/curobo/curobo/content/configs/robot/franka.yml"
    fr3 = RobotModel.from_urdf(real_data / "franka_description/expanded/fr3.urdf", yaml)
    assert set(fr3.sphere_set.links) == {f"fr3_link{i}" for i in range(8)}
    assert fr3.left_out == ("panda_hand", "panda_leftfinger", "panda_rightfinger")
    fingers = {"fr3_finger_joint1": 0.04, "fr3_finger_joint2": 0.04}
    hand = RobotModel.from_urdf(real_data / "franka_description/expanded/fr3_hand.urdf", yaml, locked=fingers)
    assert (hand.num_joints, hand.left_out, len(hand.sphere_set.radii)) == (7, (), 61)


def test_links_without_a_sphere_are_said(plain_arm: Path, real_data: Path, tmp_path: Path) -> None:
    urdf = plain_arm / "tabletop" / "robot.urdf"
    assert RobotModel.from_urdf(urdf, plain_arm / "tabletop" / "robot_spheres.yaml").doubts == ()
    few = tmp_path / "few.yaml"
    few.write_text(
        "collision_spheres: {link3: [{center: [0, 0, 0], radius: 0.05}], gripper: [{center: [0, 0, 0], radius: 0.1}]}"
    )
    model = RobotModel.from_urdf(urdf, few)
    assert "link3" not in model.bare_links and {"link0", "link7", "hand"} <= set(model.bare_links)
    assert "no sphere covers link0" in model.doubts[0] and "gripper" in model.doubts[1]
    foreign = real_data / "robot_spheres/curobo/curobo/content/configs/robot/franka.yml"
    assert any("same robot" in doubt for doubt in RobotModel.from_urdf(urdf, foreign).doubts)


def test_frames_and_spheres_stand_and_move_as_pinocchio_says(arm: RobotModel, arm_files: tuple[Path, Path]) -> None:
    np.testing.assert_allclose(arm.base_position, T_WORLD_BASE[:3, 3])
    model = pinocchio.buildModelFromUrdf(str(arm_files[0]))
    data, base = model.createData(), T_WORLD_BASE[:3, :3]
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (20, arm.num_joints)):
        pinocchio.framesForwardKinematics(model, data, q)
        poses = {}
        for link in {arm.frame_names[-1], *arm.sphere_set.links}:
            index = model.getFrameId(link, pinocchio.FrameType.BODY)
            poses[link] = T_WORLD_BASE @ data.oMf[index].homogeneous
            np.testing.assert_allclose(arm.frame_pose(q, link), poses[link], atol=1e-12)
            jacobian = np.asarray(
                pinocchio.computeFrameJacobian(model, data, q, index, pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            )
            expected = np.vstack([base @ jacobian[:3], base @ jacobian[3:]])
            np.testing.assert_allclose(arm.frame_jacobian(q, link), expected, atol=1e-12)
        spheres = zip(arm.sphere_set.links, arm.sphere_set.centers, strict=True)
        expected = np.array([(poses[link] @ [*center, 1.0])[:3] for link, center in spheres])
        np.testing.assert_allclose(arm.sphere_centers(q), expected, atol=1e-12)
        centers, jacobians = arm.spheres_at(q)
        np.testing.assert_allclose(centers, expected, atol=1e-12)
        np.testing.assert_array_equal(jacobians, arm.spheres_at(q)[1])


def test_batches_are_the_same_at_any_thread_count(arm: RobotModel) -> None:
    q = np.random.default_rng(1).uniform(-1, 1, (500, arm.num_joints))
    one = arm.sphere_centers_batch(q)
    np.testing.assert_array_equal(arm.sphere_centers_batch(q, threads=3), one)
    np.testing.assert_array_equal(one[123], arm.sphere_centers(q[123]))
    assert arm.sphere_centers_batch(q[:0]).shape == (0, len(arm.sphere_set.radii), 3)


def test_what_a_robot_carries_is_part_of_it_and_moves_with_its_link(arm: RobotModel) -> None:
    box = Box(lower=np.array([-0.02, -0.02, 0.12]), upper=np.array([0.02, 0.02, 0.20]))
    carrying, num = arm.carrying([("hand", box)]), len(arm.sphere_set.radii)
    assert (carrying.joint_names, len(arm.sphere_set.radii)) == (arm.joint_names, num)
    assert carrying.moving_spheres[num:].all() and carrying.sphere_set.links[num:] == ("hand",) * 12
    for q in (arm.middle, arm.middle + 0.4):
        T = arm.frame_pose(q, "hand")
        bottom = T[:3, :3] @ [0.0, 0.0, 0.20] + T[:3, 3]
        for robot, is_in in ((arm, False), (carrying, True)):
            away = np.linalg.norm(robot.sphere_centers(q) - bottom, axis=1) - robot.sphere_set.radii
            assert bool(away.min() < 0.0) is is_in
        surface = carrying.surface
        poses = surface.poses({link: carrying.frame_pose(q, link) for link in surface.links})
        assert surface.distance(poses, bottom[None])[0] == pytest.approx(0.0, abs=1e-9)
    own = carrying.self_pairs()
    links = np.array(carrying.sphere_set.links)
    assert not np.any((own >= num) & np.isin(links[own[:, ::-1]], ["hand", "link7"])) and np.any(own >= num)
