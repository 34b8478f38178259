"""Runs in which one thing is broken, each made of the stage's safe one."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from splatctrl_cli.records import LossReport
from splatctrl_cli.voxels import LostEdges, Unseen
from tests.cli.replay_desk import SECOND, START
from tests.jobs.stage import (
    FAR,
    QUARTER,
    Beside,
    Stage,
    ball_beside,
    passing,
    resting,
    states_on,
    unseen_about,
    voxels,
)

Change = dict[str, Any] | Callable[[Stage], None]
"""Fields of the stage, or what sets those that follow from its arm."""


def break_by(stage: Stage, change: Change) -> None:
    if isinstance(change, dict):
        vars(stage).update(change)
    else:
        change(stage)


TURN = np.eye(7)[0]
NEAR_MARGIN: Change = {"balls": [FAR, Beside(0.01)]}
IN_CONTACT: Change = {"balls": [FAR, Beside(-0.01)]}
DROPPED_STATES: Change = {"loss": LossReport(conflicting_states=1)}
LATE_MAPS: Change = {"map_stamps": [6 * SECOND // 10, 8 * SECOND // 10, SECOND]}
NO_NEW_MAP: Change = {"states": resting(num=21), "map_stamps": [0, QUARTER]}
GAP_IN_THE_LOG: Change = {"states": [*passing()[:3], *passing()[7:]], "balls": [FAR, Beside(0.2)]}
DISPLACED_CAMERA: Change = {  # it sees the robot 9 mm from where its joints put it
    "metrics": {"displaced_cameras": {"cam0": {"distance_mm": 9.0, "sigma_mm": 1.0, "num_pixels": 5000}}}
}
MASKED = {"median_mm": 0.1, "sign": 1, "num_pixels": 900}
BLIND_BESIDE_THE_ROBOT: Change = {  # a map that took what is within 45 mm of the hand for it
    "metrics": {
        "self_mask": {"link5": MASKED | {"reach_mm": 7.0}, "hand": MASKED | {"reach_mm": 45.0}},
        "self_mask_residual_mm": 0.1,
    }
}


def met_between_states(stage: Stage) -> None:
    """The hand passes a small ball midway between two states, half a radian apart."""
    way = START + 0.5 * TURN * np.array([[-1.5], [-0.5], [0.5], [1.5]])
    stage.balls = [FAR, ball_beside(stage.arm, START, 0.01, way=way[1:3], radius=0.01)]
    stage.states = states_on(way, step_ns=QUARTER)


def folded(stage: Stage) -> None:
    """At a posture within the limits in which the arm meets itself."""
    arm, pairs, radii = stage.arm, stage.arm.self_pairs(), stage.arm.sphere_set.radii
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (2000, 7)):
        centers = arm.sphere_centers(q)
        gaps = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1) - radii[pairs].sum(axis=1)
        if gaps.min() < -0.01 and np.linalg.norm(centers - np.array(FAR[0]), axis=1).min() > 0.5:
            stage.states = resting(q)
            return
    raise AssertionError


def outside_limits(stage: Stage) -> None:
    stage.states = resting(np.append(stage.arm.lower[0] - 0.05, START[1:]))


def beside_an_unseen_side(stage: Stage) -> None:
    """The arm ends 25 mm from a ball whose surroundings no camera saw."""
    stage.states = passing(1.8 * TURN)
    center, radius = stage.ball_at_the_end(0.025)
    stage.balls, stage.last_seen = [FAR, (center, radius)], unseen_about(center, radius + 0.1)


def no_answer_beside_it(stage: Stage) -> None:
    """Nobody got depth from the voxel that the arm ends beside, of which a fifth is asked about at a time."""
    stage.last_seen = voxels()
    grid = stage.last_seen.grid
    center, _ = stage.ball_at_the_end(0.01 + grid.voxel / 2, radius=0.0)
    cell = np.round((center - grid.origin) / grid.voxel)
    grid.origin[:] = center - grid.voxel * cell
    stage.last_seen.last_seen[tuple(cell.astype(int))] = Unseen.UNANSWERED


def beside_a_lost_edge(stage: Stage) -> None:
    """A surface may go on in a pixel that the arm ends beside, as at the front edge of a board in a shelf."""
    center, radius = stage.ball_at_the_end(0.011, radius=0.0065)
    edge = LostEdges(centers=np.array([center], np.float32), radii=np.array([radius], np.float32))
    stage.last_seen = replace(voxels(), edges=edge)


def beside_a_lost_edge_at_the_last_moment(stage: Stage) -> None:
    """It comes there in the 0.15 s since the time at which all is looked at."""
    stage.states = states_on(START + 0.6 * TURN * np.linspace(0, 1, 12)[:, None], step_ns=SECOND // 20)
    beside_a_lost_edge(stage)


def came_unwatched(stage: Stage) -> None:
    """Between two maps 0.75 s apart the arm passes a place where the second has a ball."""
    stage.map_stamps = [0, QUARTER, SECOND]
    stage.states = passing(np.array([1.2, 0.1, 0, 0, 0, 0, 0]))
    way = [state.position for state in stage.states]
    stage.later, stage.later_from = [ball_beside(stage.arm, way[6], 0.0, way=np.array(way[-2:]))], SECOND


def without_a_splat(stage: Stage) -> None:
    stage.unrepresented = [stage.ball_at_the_end(0.01, radius=0.05 * 3**0.5)[0]]


Broken = tuple[Change, tuple[str, ...], str, str, str]
ALONE: dict[str, Broken] = {
    "margin": (NEAR_MARGIN, (), "clearance", "margin broken", "near object splat 1"),
    "contact": (IN_CONTACT, (), "clearance", "contact", "penetrates the scene"),
    "self-collision": (folded, (), "self-clearance", "contact", "overlap by"),
    "fixed sphere": (
        {"later": [Beside(-0.01, is_at_mount=True)]},
        (),
        "static clearance",
        "contact",
        "which no joint moves",
    ),
    "position limits": (outside_limits, (), "position limits", "limits broken", "joint1 is 0.0500 rad"),
    "velocity limits": (
        {"states": passing(0.9 * TURN, num=5)},  # 2.25 rad/s, limit 2.175
        (),
        "velocity limits",
        "limits broken",
        "joint1 reaches 1.0",
    ),
    "a jump by pi": (
        {"states": states_on(START + np.outer([1.6] * 5 + [1.6 - np.pi] + [1.6] * 5, np.eye(7)[6]))},
        (),
        "velocity limits",
        "limits broken",
        "joint7 reaches",
    ),
    "between states": (
        met_between_states,
        ("--set", "verdict.longest_interval=0.3"),
        "clearance between states",
        "not evaluable",
        "on a straight path between two states the arm is at most",
    ),
    "surface deficit": (  # spheres of the hand 20 mm smaller, 10 mm more than the margin from a ball
        {"smaller": {"hand": 0.02}, "balls": [FAR, Beside(0.01)]},
        (),
        "surface clearance",
        "not evaluable",
        "the spheres keep 3",
    ),
    "bare link": ({"smaller": {"link5": np.inf}}, (), "surface clearance", "not evaluable", "no sphere on link5"),
    "unseen space": (
        {"states": passing(1.8 * TURN), "last_seen": voxels(is_seen=False)},
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
        {"states": resting(num=21), "map_stamps": [i * QUARTER for i in range(9)], "last_seen": voxels(0)},
        (),
        "evidence age",
        "not evaluable",
        "frames that have no depth or repeat it do not count",
    ),
    "frames ahead": (
        {"last_seen": voxels(2 * SECOND)},
        (),
        "evidence age",
        "not evaluable",
        "is 2.00 s newer than the state",
    ),
    "unwatched": (came_unwatched, (), "evidence age", "not evaluable", "arm from 0.25 to 1.00 s, and then"),
    "unwatched end": (  # the first map after the motion, 1.05 s after the one before, shows a ball
        {
            "map_stamps": [0, QUARTER, SECOND + 3 * QUARTER // 2],
            "later": [Beside(0.01)],
            "later_from": SECOND + QUARTER,
        },
        (),
        "evidence age",
        "not evaluable",
        "10.0 mm from the arm's place",
    ),
    "late map": (  # from 0.9 s on a ball is where the arm ends at 1 s, and the map of 1 s is known 0.2 s later
        {"later": [Beside(-0.01)], "later_from": 9 * SECOND // 10},
        ("--latency", "0.2"),
        "map age",
        "contact",
        "depth of 0.80 s, not yet in the map",
    ),
    "next map": (  # the first map after the motion, a quarter of a second later, shows a ball
        {"map_stamps": [i * QUARTER for i in range(6)], "later": [Beside(0.01)], "later_from": SECOND + 1},
        (),
        "map age",
        "not evaluable",
        "the next depth, 0.25 s after the last state",
    ),
    "gap": (GAP_IN_THE_LOG, (), "judged time", "not evaluable", "0.50 s of 1.00 s lie between states"),
    "three stamps": (
        {"states": passing()[::5], "balls": [FAR, Beside(0.2)]},
        (),
        "judged time",
        "not evaluable",
        "2 gaps",
    ),
    "dropped states": (DROPPED_STATES, (), "judged states", "not evaluable", "1 logged states were dropped"),
    "lead-in": (LATE_MAPS, (), "judged time", "not evaluable", "--start-time first-map"),
    "one map": (
        {"map_stamps": [SECOND]},
        (),
        "judged time",
        "not evaluable",
        "the first 1.00 s (10 states) come before",
    ),
    "latency": ({}, ("--latency", "0.9"), "judged time", "not evaluable", "come before the first map"),
    "coarse map": (
        {"metrics": {"voxel": 0.03}},
        (),
        "map resolution",
        "not evaluable",
        "voxels of 30.0 mm, allowed 25.0 mm",
    ),
    "blind map": (
        BLIND_BESIDE_THE_ROBOT,
        (),
        "map resolution",
        "not evaluable",
        "within 45.0 mm of hand count as",
    ),
    "displaced camera": (DISPLACED_CAMERA, (), "calibration", "not evaluable", "cam0 sees the robot 9.0 mm"),
    "starved map": (without_a_splat, (), "clearance", "not evaluable", "raise --max-splats"),
}
"""By name: what breaks it, arguments, and the criterion, label and words of the verdict."""
ELSEWHERE = {  # criteria that take more than a broken thing: each has a test of its own
    *("certified clearance", "true clearance", "acceleration limits", "controller", "scene hits", "goal", "clocks"),
    *("clearance of people", "map error", "evidence"),
}
