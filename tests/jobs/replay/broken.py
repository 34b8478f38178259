"""Runs in which one thing is broken, each made of the stage's safe one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from splatctrl_cli.records import Float64, LossReport
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import LostEdges, Unseen
from tests.cli.replay_desk import SECOND, START
from tests.jobs.stage import FAR, QUARTER, Stage, ball_beside, passing, resting, states_on, unseen_about, voxels


def self_collision(arm: RobotModel) -> Float64:
    """A posture within the limits in which the arm meets itself."""
    pairs, radii = arm.self_pairs(), arm.sphere_set.radii
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (2000, 7)):
        centers = arm.sphere_centers(q)
        gaps = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1) - radii[pairs].sum(axis=1)
        if gaps.min() < -0.01 and np.linalg.norm(centers - np.array(FAR[0]), axis=1).min() > 0.5:
            return np.asarray(q)
    raise AssertionError


def less_of(stage: Stage, change: Callable[[dict[str, list[dict[str, object]]]], None]) -> Path:
    """The robot's spheres with a change."""
    document = yaml.safe_load(Path(stage.desk.robot[3]).read_text())
    change(document["collision_spheres"])
    path = stage.desk.folder / "fewer.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def coarse_voxels(stage: Stage) -> None:
    """The scene of a reconstruction that did not know of the robot, of things at 1.2 m."""
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": stage.map_stamps[-1], "voxel": 0.03}
    stage.run = {"metrics": metrics}


def displaced_camera(stage: Stage) -> None:
    """The scene of a camera that sees the robot 9 mm from where its joints put it."""
    off = {"cam0": {"distance_mm": 9.0, "sigma_mm": 1.0, "num_pixels": 5000}}
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": stage.map_stamps[-1], "displaced_cameras": off}
    stage.run = {"metrics": metrics}


def near_margin(stage: Stage) -> None:
    stage.balls = [FAR, stage.ball_at_the_end(0.01)]


def in_contact(stage: Stage) -> None:
    stage.balls = [FAR, stage.ball_at_the_end(-0.01)]


def met_between_states(stage: Stage) -> None:
    """The hand passes a small ball midway between two states, half a radian apart."""
    turn = np.array([0.5, 0, 0, 0, 0, 0, 0])
    ball = ball_beside(stage.arm, START, 0.01, way=START + np.array([[-0.5], [0.5]]) * turn, radius=0.01)
    stage.balls = [FAR, ball]
    stage.states = states_on(START + np.array([[-1.5], [-0.5], [0.5], [1.5]]) * turn, step_ns=QUARTER)


def folded(stage: Stage) -> None:
    stage.states = resting(self_collision(stage.arm))


def met_at_the_mount(stage: Stage) -> None:
    stage.later = [beside_the_mount(stage.arm)]


def beside_the_mount(arm: RobotModel, gap: float = -0.01) -> tuple[tuple[float, float, float], float]:
    """A ball behind the base, `gap` from its hindmost sphere, which no joint moves."""
    x, y, z = arm.sphere_centers(START)[0]
    assert not arm.moving_spheres[0]
    return (float(x - arm.sphere_set.radii[0] - gap - 0.01), float(y), float(z)), 0.01


def outside_limits(stage: Stage) -> None:
    q = START.copy()
    q[0] = stage.arm.lower[0] - 0.05
    stage.states = resting(q)


def too_fast(stage: Stage) -> None:
    stage.states = passing(np.array([0.9, 0, 0, 0, 0, 0, 0]), num=5)  # 2.25 rad/s, limit 2.175


def jumped(stage: Stage) -> None:
    positions = np.tile(START, (11, 1))
    positions[:, 6] = 1.6
    positions[5, 6] -= np.pi
    stage.states = states_on(positions)


def little_covered(stage: Stage) -> None:
    """Spheres of the hand 20 mm smaller, 10 mm more than the margin from a ball."""

    def shrink(spheres: dict[str, list[dict[str, object]]]) -> None:
        for one in spheres["hand"]:
            one["radius"] = float(one["radius"]) - 0.02  # type: ignore[arg-type]

    stage.spheres = less_of(stage, shrink)
    stage.balls = [FAR, stage.ball_at_the_end(0.01)]


def bare_forearm(stage: Stage) -> None:
    def remove(spheres: dict[str, list[dict[str, object]]]) -> None:
        del spheres["link5"]

    stage.spheres = less_of(stage, remove)


def never_seen_where_it_goes(stage: Stage) -> None:
    stage.states = passing(np.array([1.8, 0, 0, 0, 0, 0, 0]), num=11)
    stage.last_seen = voxels(is_seen=False)


def beside_an_unseen_side(stage: Stage) -> None:
    """The arm ends 25 mm from a ball whose surroundings no camera saw."""
    stage.states = passing(np.array([1.8, 0, 0, 0, 0, 0, 0]), num=11)
    ball = stage.ball_at_the_end(0.025)
    stage.balls, stage.last_seen = [FAR, ball], unseen_about(ball[0], ball[1] + 0.1)


def no_answer_beside_it(stage: Stage) -> None:
    """Nobody got depth from the voxel that the arm ends beside, of which a fifth is asked about at a time."""
    stage.last_seen = voxels()
    grid = stage.last_seen.grid
    center, _ = stage.ball_at_the_end(0.01 + grid.voxel / 2, radius=0.0)
    grid.origin[:] = center - grid.voxel * np.round((center - grid.origin) / grid.voxel)
    stage.last_seen.last_seen[tuple(np.round((center - grid.origin) / grid.voxel).astype(int))] = Unseen.UNANSWERED


def beside_a_lost_edge(stage: Stage) -> None:
    """A surface may go on in a pixel that the arm ends beside, as at the front edge of a board in a shelf."""
    center, radius = stage.ball_at_the_end(0.011, radius=0.0065)
    edge = LostEdges(centers=np.array([center], np.float32), radii=np.array([radius], np.float32))
    stage.last_seen = replace(voxels(), edges=edge)


def beside_a_lost_edge_at_the_last_moment(stage: Stage) -> None:
    """It comes there in the 0.15 s since the time at which all is looked at."""
    move = np.linspace(0, 1, 12)[:, None] * np.array([0.6, 0, 0, 0, 0, 0, 0])
    stage.states = states_on(START + move, step_ns=SECOND // 20)
    beside_a_lost_edge(stage)


def frames_that_renew_nothing(stage: Stage) -> None:
    stage.states = resting(num=21)
    stage.map_stamps = [i * QUARTER for i in range(9)]
    stage.last_seen = voxels(0)


def frames_of_the_future(stage: Stage) -> None:
    stage.last_seen = voxels(2 * SECOND)


def came_unwatched(stage: Stage) -> None:
    """Between two maps 0.75 s apart the arm passes a place where the second has a ball."""
    stage.map_stamps = [0, QUARTER, SECOND]
    stage.states = passing(np.array([1.2, 0.1, 0, 0, 0, 0, 0]))
    way = [state.position for state in stage.states]
    stage.later, stage.later_from = [ball_beside(stage.arm, way[6], 0.0, way=np.array(way[-2:]))], SECOND


def came_after_the_last_map(stage: Stage) -> None:
    """The first map after the motion, 1.05 s after the one before, has a ball where the arm came to rest."""
    stage.map_stamps = [0, QUARTER, SECOND + 3 * QUARTER // 2]
    stage.later, stage.later_from = [stage.ball_at_the_end(0.01)], SECOND + QUARTER


def came_before_a_late_map(stage: Stage) -> None:
    """From 0.9 s on a ball is where the arm ends at 1 s, and the map of 1 s is known 0.2 s later."""
    stage.later, stage.later_from = [stage.ball_at_the_end(-0.01)], 9 * SECOND // 10


def came_before_the_next_map(stage: Stage) -> None:
    """The first map after the motion, a quarter of a second later, has a ball where the arm came to rest."""
    stage.map_stamps = [i * QUARTER for i in range(6)]
    stage.later, stage.later_from = [stage.ball_at_the_end(0.01)], SECOND + 1


def blind_beside_the_robot(stage: Stage) -> None:
    """A map that took what is within 45 mm of the hand for it."""
    row = {"median_mm": 0.1, "sign": 1, "num_pixels": 900}
    by_link = {"link5": row | {"reach_mm": 7.0}, "hand": row | {"reach_mm": 45.0}}
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": stage.map_stamps[-1], "self_mask": by_link}
    stage.run = {"metrics": metrics | {"self_mask_residual_mm": 0.1}}


def no_new_map(stage: Stage) -> None:
    stage.states = resting(num=21)
    stage.map_stamps = [0, QUARTER]


def gap_in_the_log(stage: Stage) -> None:
    del stage.states[3:7]  # type: ignore[attr-defined]
    stage.balls = [FAR, stage.ball_at_the_end(0.2)]


def three_stamps(stage: Stage) -> None:
    stage.states = stage.states[::5]
    stage.balls = [FAR, stage.ball_at_the_end(0.2)]


def dropped_states(stage: Stage) -> None:
    stage.desk.source.loss = LossReport(conflicting_states=1)


def late_maps(stage: Stage) -> None:
    stage.map_stamps = [6 * SECOND // 10, 8 * SECOND // 10, SECOND]


def one_map_at_the_end(stage: Stage) -> None:
    stage.map_stamps = [SECOND]


def without_a_splat(stage: Stage) -> None:
    center, _ = stage.ball_at_the_end(0.01, radius=0.05 * 3**0.5)
    stage.unrepresented = [center]


Broken = tuple[Callable[[Stage], None], tuple[str, ...], str, str, str]
ALONE: dict[str, Broken] = {
    "margin": (near_margin, (), "clearance", "margin broken", "near object splat 1"),
    "contact": (in_contact, (), "clearance", "contact", "penetrates the scene"),
    "self-collision": (folded, (), "self-clearance", "contact", "overlap by"),
    "fixed sphere": (met_at_the_mount, (), "static clearance", "contact", "which no joint moves"),
    "position limits": (outside_limits, (), "position limits", "limits broken", "joint1 is 0.0500 rad"),
    "velocity limits": (too_fast, (), "velocity limits", "limits broken", "joint1 reaches 1.0"),
    "a jump by pi": (jumped, (), "velocity limits", "limits broken", "joint7 reaches"),
    "between states": (
        met_between_states,
        ("--set", "verdict.longest_interval=0.3"),
        "clearance between states",
        "not evaluable",
        "on a straight path between two states the arm is at most",
    ),
    "surface deficit": (little_covered, (), "surface clearance", "not evaluable", "the spheres keep 3"),
    "bare link": (bare_forearm, (), "surface clearance", "not evaluable", "no sphere on link5"),
    "unseen space": (
        never_seen_where_it_goes,
        (),
        "known space",
        "not evaluable",
        "100 % of the space within the margin of the arm",
    ),
    "unseen side": (beside_an_unseen_side, (), "known space", "not evaluable", "from the arm through unseen space"),
    "no answer": (no_answer_beside_it, (), "known space", "not evaluable", "a place 7.7 mm from the arm"),
    "lost edge": (
        beside_a_lost_edge,
        (),
        "known space",
        "not evaluable",
        "an edge without depth is 11.0 mm from the arm",
    ),
    "lost edge at last": (
        beside_a_lost_edge_at_the_last_moment,
        (),
        "known space",
        "not evaluable",
        "an edge without depth is 11.0 mm from the arm",
    ),
    "evidence age": (
        frames_that_renew_nothing,
        (),
        "evidence age",
        "not evaluable",
        "frames that have no depth or repeat it do not count",
    ),
    "frames ahead": (frames_of_the_future, (), "evidence age", "not evaluable", "is 2.00 s newer than the state"),
    "unwatched": (came_unwatched, (), "evidence age", "not evaluable", "arm from 0.25 to 1.00 s, and then"),
    "unwatched end": (came_after_the_last_map, (), "evidence age", "not evaluable", "10.0 mm from the arm's place"),
    "late map": (
        came_before_a_late_map,
        ("--latency", "0.2"),
        "map age",
        "contact",
        "depth of 0.80 s, not yet in the map",
    ),
    "next map": (
        came_before_the_next_map,
        (),
        "map age",
        "not evaluable",
        "the next depth, 0.25 s after the last state",
    ),
    "gap": (gap_in_the_log, (), "judged time", "not evaluable", "0.50 s of 1.00 s lie between states"),
    "three stamps": (three_stamps, (), "judged time", "not evaluable", "2 gaps"),
    "dropped states": (dropped_states, (), "judged states", "not evaluable", "1 logged states were dropped"),
    "lead-in": (late_maps, (), "judged time", "not evaluable", "--start-time first-map"),
    "one map": (one_map_at_the_end, (), "judged time", "not evaluable", "the first 1.00 s (10 states) come before"),
    "latency": (lambda _: None, ("--latency", "0.9"), "judged time", "not evaluable", "come before the first map"),
    "coarse map": (coarse_voxels, (), "map resolution", "not evaluable", "voxels of 30.0 mm, allowed 25.0 mm"),
    "blind map": (
        blind_beside_the_robot,
        (),
        "map resolution",
        "not evaluable",
        "within 45.0 mm of hand count as",
    ),
    "displaced camera": (displaced_camera, (), "calibration", "not evaluable", "cam0 sees the robot 9.0 mm"),
    "starved map": (without_a_splat, (), "clearance", "not evaluable", "raise --max-splats"),
}
"""By name: what breaks it, arguments, and the criterion, label and words of the verdict."""
ELSEWHERE = {  # criteria that take more than a broken thing: each has a test of its own
    *("certified clearance", "true clearance", "acceleration limits", "controller", "scene hits", "goal", "clocks"),
    *("clearance of people", "map error", "evidence"),
}
