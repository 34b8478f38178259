"""Why a voxel beside the robot was never seen, in scenes with a known answer."""

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import ASKED_REACH
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.self_mask import self_mask
from splatctrl_cli.scene.unseen import explain_unseen
from splatctrl_cli.voxels import EvidenceClass, Unseen
from tests.scene.wall import HEIGHT, INTRINSICS, WORKSPACE, frame

CONFIG = OccupancyConfig()
MIDDLE, RADIUS = np.array([0.0, 0.0, 0.3]), 0.1  # of a robot that is a ball
ROBOT = RobotPosture(centers=MIDDLE[None], radii=np.array([RADIUS]), T_world_link=np.eye(4)[None])


def robot_and_floor() -> RgbdFrame:
    """The floor and the ball, from above."""
    seen = frame()
    v, u = np.mgrid[: INTRINSICS.height, : INTRINSICS.width]
    rays = np.stack([(u - INTRINSICS.cx) / INTRINSICS.fx, (v - INTRINSICS.cy) / INTRINSICS.fy, np.ones(u.shape)], -1)
    to_ball = np.array([0.0, 0.0, HEIGHT - MIDDLE[2]])
    squared = np.sum(rays**2, axis=2)
    half = rays @ to_ball
    root = half**2 - squared * (to_ball @ to_ball - RADIUS**2)
    ball = (half - np.sqrt(np.maximum(root, 0))) / squared
    seen.depth[root > 0] = ball[root > 0]
    return seen


def explained(*frames: RgbdFrame, robot: RobotPosture = ROBOT) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    grid.take_in(frames)
    explain_unseen(grid, [(seen, self_mask(seen, robot, CONFIG)) for seen in frames], robot)
    return grid


def class_at(grid: OccupancyMap, point: Float64 | list[float]) -> EvidenceClass:
    step = np.round((np.asarray(point) - grid.origin) / CONFIG.voxel).astype(int)
    last = int(grid.last_seen[tuple(step)])
    return EvidenceClass[Unseen(last).name] if last >= min(Unseen) else EvidenceClass.FREE


def test_each_voxel_beside_the_robot_has_its_reason() -> None:
    seen = robot_and_floor()
    seen.depth[:, :28] = 0.6  # a thing to the left, nearer to the camera than the robot
    seen.depth[:12] = 0.0  # the far background
    grid = explained(seen)
    assert class_at(grid, [0.0, 0.0, 0.45]) == EvidenceClass.FREE
    assert class_at(grid, [0.0, 0.0, 0.3]) == EvidenceClass.SWEPT
    assert class_at(grid, [0.0, 0.0, 0.15]) == EvidenceClass.HIDDEN_BY_ARM
    assert class_at(grid, [-0.15, 0.0, 0.2]) == EvidenceClass.HIDDEN_BY_THING
    assert class_at(grid, [0.0, 0.2, 0.3]) == EvidenceClass.NO_RETURN
    assert not (grid.last_seen[:, :, :] == 0)[grid.last_seen.shape[0] // 2].all()


def test_what_no_camera_looks_at_is_out_of_view() -> None:
    away = RobotPosture(
        centers=MIDDLE[None] + [0.4, 0.0, 0.2], radii=np.array([RADIUS]), T_world_link=np.eye(4)[None]
    )
    grid = explained(frame(x=-0.4), robot=away)
    assert class_at(grid, [0.43, 0.0, 0.35]) == EvidenceClass.OUT_OF_VIEW


def test_only_what_is_near_the_robot_is_asked_about() -> None:
    grid = explained(robot_and_floor())
    cells = np.argwhere(grid.last_seen >= min(Unseen))
    away = np.linalg.norm(grid.origin + CONFIG.voxel * cells - MIDDLE, axis=1) - RADIUS
    assert len(cells) and away.max() < ASKED_REACH + CONFIG.voxel


def test_a_reason_passes_when_a_ray_does_and_another_may_follow() -> None:
    """The robot goes, and its shadow with it; a thing hides what it hid."""
    grid = explained(robot_and_floor())
    under = [0.0, 0.0, 0.15]
    assert class_at(grid, under) == EvidenceClass.HIDDEN_BY_ARM
    thing = frame()
    thing.depth[:] = 0.4
    explain_unseen(grid, [(thing, self_mask(thing, ROBOT, CONFIG))], ROBOT)
    assert class_at(grid, under) == EvidenceClass.HIDDEN_BY_THING
    grid.take_in([frame()])
    assert class_at(grid, under) == EvidenceClass.FREE


def test_what_was_looked_at_in_vain_stays_so() -> None:
    grid = explained(robot_and_floor())
    under = np.array([[0.0, 0.0, 0.15]])
    for reason, wanted in ((Unseen.CONTRADICTED, "CONTRADICTED"), (Unseen.UNANSWERED, "CONTRADICTED")):
        grid.mark_unseen(under, reason)  # the first stays
        explain_unseen(grid, [(robot_and_floor(), self_mask(robot_and_floor(), ROBOT, CONFIG))], ROBOT)
        assert class_at(grid, under[0]) == EvidenceClass[wanted]


@pytest.mark.parametrize("is_drawn", [True, False])
def test_the_robots_body_sweeps_and_what_sticks_out_of_it_does_not(is_drawn: bool) -> None:
    """Its spheres are 5 cm larger than what is drawn of it."""
    surface = RobotSurface.of_balls(MIDDLE[None], np.array([RADIUS]))
    large = RobotPosture(
        centers=MIDDLE[None],
        radii=np.array([RADIUS + 0.05]),
        T_world_link=np.eye(4)[None],
        surface=surface if is_drawn else None,
        T_world_surface={0: np.eye(4)[None]} if is_drawn else {},
    )
    grid = explained(robot_and_floor(), robot=large)
    assert class_at(grid, [0.0, 0.0, 0.175]) == (EvidenceClass.HIDDEN_BY_ARM if is_drawn else EvidenceClass.SWEPT)
