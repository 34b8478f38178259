"""A self-model of an arm whose link has a bracket that its URDF lacks, beside a wall and a box that stay."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.formats.arrays import read_arrays, savez
from splatctrl_cli.geometry import look_at, pose_at, turn_about_z
from splatctrl_cli.kernels.surface_image import TriangleTree
from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame
from splatctrl_cli.robot import self_fusion
from splatctrl_cli.robot.self_fusion import VOXEL, choose_moments, learn
from splatctrl_cli.robot.self_model import SelfModel
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import Shape
from tests.refused import expect_refusal

LENS = Intrinsics(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)
EYES = ((1.1, 0.1, 0.6), (-0.2, -1.1, 0.5), (0.2, 1.0, 0.9))
LINKS = ("base", "arm")
ALONG = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])  # the axis of a shape lies along x
BASE = Shape(link="base", kind="box", size=(0.16, 0.16, 0.3), T_link_shape=pose_at((0, 0, 0.15)))
ARM = Shape(link="arm", kind="capsule", size=(0.045, 0.3), T_link_shape=pose_at((0.2, 0.0, 0.0), ALONG))
BRACKET = Shape(link="arm", kind="box", size=(0.03, 0.05, 0.04), T_link_shape=pose_at((0.2, 0.0, 0.06)))
ROBOT = RobotSurface.from_parts([BASE, ARM], fixed=("base",))


def shapes(*, has_bracket: bool = True) -> list[Shape]:
    """What is truly there: the robot, its bracket, a wall, a box near the arm's path, and one beside the base."""
    return [
        BASE,
        Shape(link="base", kind="box", size=(0.05, 0.05, 0.1), T_link_shape=pose_at((0.12, 0.0, 0.05))),
        ARM,
        *([BRACKET] if has_bracket else []),
        Shape(link="world", kind="box", size=(0.02, 3.0, 3.0), T_link_shape=pose_at((-0.6, 0.0, 0.5))),
        Shape(link="world", kind="box", size=(3.0, 3.0, 0.02), T_link_shape=pose_at((0.0, 0.0, -0.01))),
        Shape(link="world", kind="box", size=(0.1, 0.1, 0.3), T_link_shape=pose_at((0.3, 0.35, 0.15))),
    ]


def poses(turn: float, lift: float) -> dict[str, Float64]:
    """Of base, world, and arm with its fingers: the arm turns about z and, at its shoulder 0.36 m up, lifts."""
    c, s = np.cos(lift), np.sin(lift)
    T = pose_at((0.0, 0.0, 0.36), turn_about_z(turn)[:3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
    return {"base": np.eye(4), "world": np.eye(4), **dict.fromkeys(("arm", "left", "right"), T)}


def recorded(
    moves: list[tuple[float, float]], truth: RobotSurface, noise: float = 0.0, robot: RobotSurface = ROBOT
) -> tuple[list[RgbdFrame], Float64]:
    frames, at = [], []
    rng = np.random.default_rng(0)
    for number, (turn, lift) in enumerate(moves):
        for camera, eye in enumerate(EYES):
            T = look_at(np.array(eye), np.array([0.1, 0.0, 0.35]))
            there = poses(turn, lift)
            depth = truth.render(truth.poses(there), LENS, T, np.zeros((LENS.height, LENS.width), np.float32)).depth
            depth = np.where(depth > 0, depth + noise * depth**2 * rng.standard_normal(depth.shape), 0)
            frames.append(
                RgbdFrame(
                    stamp_ns=number * 100_000_000,
                    camera=str(camera),
                    color=np.zeros((1, 1, 3), np.uint8),
                    depth=depth.astype(np.float32),
                    intrinsics=LENS,
                    T_world_camera=T,
                )
            )
            at.append(robot.poses(there))
    return frames, np.array(at)


MOVES = [(0.9 * np.sin(0.5 * k), 0.35 * np.sin(0.9 * k + 1.0)) for k in range(15)]


@cache
def learned(noise: float = 0.0) -> SelfModel:
    return learn(ROBOT, LINKS, *recorded(MOVES, RobotSurface.from_parts(shapes()), noise))


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_bracket_that_the_urdf_lacks_is_found_within_a_voxel_and_nothing_else_is(noise: float) -> None:
    ((link, triangles),) = learned(noise).pieces()
    assert link == "arm"
    assert RobotSurface.from_parts([BRACKET]).distance(np.eye(4)[None], triangles.reshape(-1, 3)).max() < VOXEL
    sides = [(0.2 + x, y, 0.08) for x in (-0.01, 0, 0.01) for y in (-0.02, 0.0, 0.02)]
    sides += [(0.2 + x, y, 0.07) for x in (-0.015, 0.015) for y in (-0.02, 0.0, 0.02)]
    assert TriangleTree(triangles).closest(np.array(sides))[0].max() < VOXEL


CABLE = Shape(link="arm", kind="capsule", size=(0.005, 0.2), T_link_shape=pose_at((0.2, 0.0, 0.065), ALONG))


def test_a_cable_that_one_of_three_cameras_looks_past_is_found() -> None:
    """A laser measures what is behind a thin cable; the other two outvote it."""
    frames, poses_seen = recorded(MOVES, RobotSurface.from_parts([*shapes(has_bracket=False), CABLE]))
    past, _ = recorded(MOVES, RobotSurface.from_parts(shapes(has_bracket=False)))
    mixed = [other if one.camera == "0" else one for one, other in zip(frames, past, strict=True)]
    ((link, triangles),) = learn(ROBOT, LINKS, mixed, poses_seen).pieces()
    assert link == "arm" and np.ptp(triangles[..., 0]) > 0.19


def test_what_two_fingers_hold_between_them_is_robot() -> None:
    """Each cell is nearer to one of two links that move as one; neither lets go of its half for the other's."""
    fingers = [
        Shape(link=link, kind="box", size=(0.06, 0.02, 0.06), T_link_shape=pose_at((0.4, y, 0.0)))
        for link, y in (("left", 0.05), ("right", -0.05))
    ]
    robot = RobotSurface.from_parts([BASE, ARM, *fingers], fixed=("base",))
    held = Shape(link="arm", kind="box", size=(0.05, 0.08, 0.16), T_link_shape=pose_at((0.41, 0.0, 0.0)))
    frames, at = recorded(MOVES, RobotSurface.from_parts([*shapes(has_bracket=False), *fingers, held]), robot=robot)
    found = learn(robot, robot.links, frames, at).pieces()
    assert {"left", "right"} <= {link for link, _ in found}
    corners = np.concatenate([triangles.reshape(-1, 3) for _, triangles in found])  # all frames are one here
    tips = corners[np.abs(corners[:, 2]) > 0.06]
    assert np.ptp(tips, axis=0) == pytest.approx((0.05, 0.08, 0.16), abs=2 * VOXEL)


def test_links_that_do_not_move_are_named() -> None:
    assert [*learned().unknown] == ["base"] and "moves too little" in learned().unknown["base"]
    frames, at = recorded([(0.1, 0.0)] * 6, RobotSurface.from_parts(shapes()))
    expect_refusal(r"base, arm.* moves? too little \(1 of 5 configurations\)", learn, ROBOT, LINKS, frames, at)


PLATE = Shape(link="world", kind="box", size=(1.2, 1.2, 0.02), T_link_shape=pose_at((0.0, 0.0, 0.285)))
ROD = Shape(link="world", kind="capsule", size=(0.006, 0.6), T_link_shape=pose_at((0.42, 0.0, 0.4)))
TURNS = [(-0.9 + 0.12 * k, 0.0) for k in range(15)]
NODS = [(0.0, float(lift)) for lift in np.linspace(-0.45, 0.45, 19)]


@pytest.mark.parametrize(
    ("beside", "moves", "noise"),
    [([], MOVES, 0.0), ([], MOVES, 0.003), ([PLATE], TURNS, 0.0), ([ROD], NODS, 0.0)],
    ids=["nothing", "noise", "plate", "rod"],
)
def test_an_arm_as_its_urdf_draws_it_gets_no_parts_of_what_it_moves_along(
    beside: list[Shape], moves: list[tuple[float, float]], noise: float
) -> None:
    """Both have one place in the arm's frame: a plate level under an arm that turns, a rod at which it nods."""
    truth = RobotSurface.from_parts([*shapes(has_bracket=False), *beside])
    assert learn(ROBOT, LINKS, *recorded(moves, truth, noise)).pieces() == []


SLIGHT = [(float(turn), 0.0) for turn in np.linspace(-0.08, 0.08, 11)]  # 64 mm at the tip: four configurations
BESIDE = Shape(link="world", kind="box", size=(0.1, 0.05, 0.5), T_link_shape=pose_at((0.36, 0.13, 0.25)))


@pytest.mark.parametrize("beside", [[PLATE], [ROD], [BESIDE], [BRACKET]], ids=["plate", "rod", "box", "bracket"])
def test_what_a_slight_motion_cannot_tell_from_the_scene_is_no_part(beside: list[Shape]) -> None:
    """The bracket moves with the arm, but by less than 40 mm."""
    expect_refusal(
        r"arm.* moves? too little",
        learn,
        ROBOT,
        LINKS,
        *recorded(SLIGHT, RobotSurface.from_parts([*shapes(has_bracket=False), *beside])),
    )


TOOL = Shape(link="arm", kind="box", size=(0.05, 0.04, 0.06), T_link_shape=pose_at((0.34, 0.0, 0.07)))
RIB = Shape(link="arm", kind="box", size=(0.34, 0.02, 0.02), T_link_shape=pose_at((0.17, 0.0, 0.06)))
NEAR_THE_JOINT = [(0.25 * np.sin(0.5 * k), 0.12 * np.sin(0.9 * k + 1.0)) for k in range(15)]


@pytest.mark.parametrize(
    ("part", "beside", "moves", "wide", "ends"),
    [
        pytest.param(CABLE, [], MOVES, 80, (0.095, 0.305), id="a cable narrower than a thinned pixel"),
        pytest.param(TOOL, [BESIDE], SLIGHT, self_fusion.WIDE, (0.315, 0.365), id="a tool that moves slightly"),
        pytest.param(RIB, [], NEAR_THE_JOINT, self_fusion.WIDE, (0.0, 0.34), id="a rib from the joint on"),
    ],
)
def test_a_part_of_the_arm_is_found_from_end_to_end(
    monkeypatch: pytest.MonkeyPatch,
    part: Shape,
    beside: list[Shape],
    moves: list[tuple[float, float]],
    wide: int,
    ends: tuple[float, float],
) -> None:
    """Each fourth pixel of a wide image says which link is seen; depth is read at each."""
    monkeypatch.setattr(self_fusion, "WIDE", wide)
    truth = RobotSurface.from_parts([*shapes(has_bracket=False), part, *beside])
    ((link, triangles),) = learn(ROBOT, LINKS, *recorded(moves, truth)).pieces()
    assert link == "arm"
    assert RobotSurface.from_parts([part]).distance(np.eye(4)[None], triangles.reshape(-1, 3)).max() < 2 * VOXEL
    assert (triangles[..., 0].min(), triangles[..., 0].max()) == pytest.approx(ends, abs=2 * VOXEL)


def test_the_pieces_belong_to_the_surface_that_is_rendered_and_measured() -> None:
    surface = ROBOT.joined(learned().pieces())
    T = surface.poses(poses(0.0, 0.0))
    point = np.array([[0.2, 0.0, 0.36 + 0.18]])  # 10 cm above the bracket's top
    assert surface.distance(T, point) == pytest.approx(0.1, abs=VOXEL)
    assert ROBOT.distance(T, point) == pytest.approx(0.135, abs=1e-6)


def test_a_self_model_is_read_as_it_was_written_and_refused_for_another_robot(tmp_path: Path) -> None:
    path = tmp_path / "self.npz"
    savez(path, learned().arrays())
    found = SelfModel.from_arrays(read_arrays(path, most=2**30))
    assert np.array_equal(found.pieces()[0][1], learned().pieces()[0][1])
    assert (found.unknown, found.learned[0].since) == (learned().unknown, learned().learned[0].since)
    found.check_robot(ROBOT, LINKS, path)
    expect_refusal("another robot: one of the two lacks gripper", found.check_robot, ROBOT, (*LINKS, "gripper"), path)
    expect_refusal(
        "its visual geometry differs", found.check_robot, replace(ROBOT, sizes=1.1 * ROBOT.sizes), LINKS, path
    )


def test_moments_are_those_between_which_the_arm_moved_farthest() -> None:
    at = np.array([ROBOT.poses(poses(turn, 0.0)) for turn in (0.0, 0.001, 0.4, 0.41, 0.8)])
    assert (choose_moments(ROBOT, at), choose_moments(ROBOT, at, most=2)) == ([0, 2, 4], [0, 4])
