"""Why a voxel beside the robot was never seen, in scenes with a known answer."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import ASKED_REACH
from splatctrl_cli.geometry import back_project
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.scene.depth_holes import explain_unseen
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.self_mask import self_mask
from splatctrl_cli.voxels import EvidenceClass, Unseen
from tests.scene.wall import HEIGHT, INTRINSICS, WORKSPACE, frame

CONFIG = OccupancyConfig()
MIDDLE, RADIUS = np.array([0.0, 0.0, 0.3]), 0.1  # of a robot that is a ball
ROBOT = RobotPosture(centers=MIDDLE[None], radii=np.array([RADIUS]), T_world_link=np.eye(4)[None])


def robot_and_floor() -> RgbdFrame:
    """The floor and the ball, from above."""
    seen, to_ball = frame(), np.array([0.0, 0.0, HEIGHT - MIDDLE[2]])
    rays = back_project(INTRINSICS, np.ones((INTRINSICS.height, INTRINSICS.width)))
    squared, half = np.sum(rays**2, axis=2), rays @ to_ball
    root = half**2 - squared * (to_ball @ to_ball - RADIUS**2)
    seen.depth[root > 0] = ((half - np.sqrt(np.maximum(root, 0))) / squared)[root > 0]
    return seen


def explained(*frames: RgbdFrame, robot: RobotPosture = ROBOT) -> OccupancyMap:
    grid = OccupancyMap(WORKSPACE, CONFIG, 1)
    grid.take_in(frames)
    return explain(grid, *frames, robot=robot)


def explain(grid: OccupancyMap, *frames: RgbdFrame, robot: RobotPosture = ROBOT) -> OccupancyMap:
    explain_unseen(grid, [(seen, self_mask(seen, robot, CONFIG)) for seen in frames], robot)
    return grid


def class_at(grid: OccupancyMap, *points: tuple[float, float, float]) -> list[EvidenceClass]:
    last = grid.last_seen[tuple(np.round((np.array(points) - grid.origin) / CONFIG.voxel).astype(int).T)].tolist()
    return [EvidenceClass[Unseen(each).name] if each >= min(Unseen) else EvidenceClass.FREE for each in last]


UNDER = (0.0, 0.0, 0.15)


def test_each_voxel_beside_the_robot_has_its_reason() -> None:
    """A thing to the left is nearer to the camera than the robot, and the far background returns nothing."""
    seen = robot_and_floor()
    seen.depth[:, :28] = 0.6
    seen.depth[:12] = 0.0
    grid = explained(seen)
    assert class_at(grid, (0.0, 0.0, 0.45), (0.0, 0.0, 0.3), UNDER, (-0.15, 0.0, 0.2), (0.0, 0.2, 0.3)) == [
        EvidenceClass.FREE,
        EvidenceClass.SWEPT,
        EvidenceClass.HIDDEN_BY_ARM,
        EvidenceClass.HIDDEN_BY_THING,
        EvidenceClass.NO_RETURN,
    ]
    assert not (grid.last_seen == 0)[grid.last_seen.shape[0] // 2].all()


def test_what_no_camera_looks_at_is_out_of_view() -> None:
    grid = explained(frame(x=-0.4), robot=replace(ROBOT, centers=MIDDLE[None] + [0.4, 0.0, 0.2]))
    assert class_at(grid, (0.43, 0.0, 0.35)) == [EvidenceClass.OUT_OF_VIEW]


def test_only_what_is_near_the_robot_is_asked_about() -> None:
    grid = explained(robot_and_floor())
    centers = grid.origin + CONFIG.voxel * np.argwhere(grid.last_seen >= min(Unseen))
    away = np.linalg.norm(centers - MIDDLE, axis=1) - RADIUS
    assert len(away) and away.max() < ASKED_REACH + CONFIG.voxel


def test_a_reason_passes_when_a_ray_does_and_another_may_follow() -> None:
    """The robot goes, and its shadow with it; a thing hides what it hid."""
    grid, thing = explained(robot_and_floor()), frame()
    assert class_at(grid, UNDER) == [EvidenceClass.HIDDEN_BY_ARM]
    thing.depth[:] = 0.4
    assert class_at(explain(grid, thing), UNDER) == [EvidenceClass.HIDDEN_BY_THING]
    grid.take_in([frame()])
    assert class_at(grid, UNDER) == [EvidenceClass.FREE]


def test_what_was_looked_at_in_vain_stays_so() -> None:
    """The first reason stays."""
    grid = explained(robot_and_floor())
    for reason in (Unseen.CONTRADICTED, Unseen.UNANSWERED):
        grid.mark_unseen(np.array([UNDER]), reason)
        assert class_at(explain(grid, robot_and_floor()), UNDER) == [EvidenceClass.CONTRADICTED]


@pytest.mark.parametrize("is_drawn", [True, False])
def test_the_robots_body_sweeps_and_what_sticks_out_of_it_does_not(is_drawn: bool) -> None:
    """Its spheres are 5 cm larger than what is drawn of it."""
    large = replace(ROBOT, radii=np.array([RADIUS + 0.05]))
    if is_drawn:
        large = replace(
            large,
            surface=RobotSurface.from_balls(MIDDLE[None], np.array([RADIUS])),
            T_world_surface={0: np.eye(4)[None]},
        )
    expected = EvidenceClass.HIDDEN_BY_ARM if is_drawn else EvidenceClass.SWEPT
    assert class_at(explained(robot_and_floor(), robot=large), (0.0, 0.0, 0.175)) == [expected]
