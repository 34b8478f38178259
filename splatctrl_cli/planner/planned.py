"""Timed paths for a replay's task, in the scene known at its start.

G goal postures, K guesses, J joints.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from splatctrl_cli.config import ControlConfig, PlannerConfig, fixed
from splatctrl_cli.control.barriers import scene_margin
from splatctrl_cli.control.goals import Detour, PlanDetour, TimedPath, pose_error
from splatctrl_cli.control.replay import ReplayTask
from splatctrl_cli.errors import refuse_if
from splatctrl_cli.planner.birrt import Plan, PlanOutcome, plan
from splatctrl_cli.planner.configuration_clearance import Clearance, HasDistance, check_edges
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel


def resample(waypoints: Float64, spacing: float) -> Float64:
    """Postures (K, J) at most `spacing` [rad] apart, with every waypoint."""
    rows = [waypoints[:1]]
    for a, b in pairwise(waypoints):
        num = max(int(np.ceil(np.linalg.norm(b - a) / spacing)), 1)
        rows.append(a + np.arange(1, num + 1)[:, None] / num * (b - a))
    return np.concatenate(rows)


def effector_rates(
    model: RobotModel, waypoints: Float64, frame: str, *, max_linear: float, max_angular: float
) -> Float64:
    """Greatest edge shares per second (W - 1,) within a frame's speeds [m/s], [rad/s].

    Edges are sampled `FRAME_SPACING` apart. Infinite where an edge does not move the frame.
    """
    rates = np.full(len(waypoints) - 1, np.inf)
    for edge, ends in enumerate(pairwise(waypoints)):
        for q in resample(np.array(ends), fixed.FRAME_SPACING):
            twist = model.frame_jacobian(q, frame) @ (ends[1] - ends[0])
            for part, limit in ((twist[:3], max_linear), (twist[3:], max_angular)):
                speed = float(np.linalg.norm(part))
                rates[edge] = min(rates[edge], limit / speed if speed > 0 else np.inf)
    return rates


def time_path(
    waypoints: Float64, velocity_limit: Float64, max_acceleration: float, *, max_rate: Float64 | None = None
) -> TimedPath:
    """Fastest trapezoidal speeds within velocity_limit (J,) [rad/s] and max_acceleration [rad/s^2].

    max_rate (W - 1,): greatest edge shares per second. Raises InputError for fewer than two waypoints or limits not
    above zero.
    """
    refuse_if(len(waypoints) < 2, f"path: expected at least 2 waypoints, got {len(waypoints)}")
    refuse_if(
        not (np.min(velocity_limit) > 0 and max_acceleration > 0),
        "path: expected velocity and acceleration limits above 0",
    )
    motion = np.abs(np.diff(waypoints, axis=0))
    is_long = np.max(motion, axis=1) > 0
    motion, is_new = motion[is_long], np.r_[True, is_long]
    fastest = np.inf if max_rate is None else max_rate[is_long]
    speed = np.minimum(np.min(velocity_limit / np.maximum(motion, 1e-12), axis=1), fastest)
    acceleration = max_acceleration / np.max(motion, axis=1)
    speed = np.minimum(speed, np.sqrt(acceleration))  # a short edge is a triangle
    seconds = 1.0 / speed + speed / acceleration
    return TimedPath(
        waypoints=waypoints[is_new],
        start_time=np.r_[0.0, np.cumsum(seconds)],
        top_speed=speed,
        acceleration=acceleration,
    )


NO_POSTURE, START_BLOCKED, GOAL_BLOCKED = "no-goal-posture", "start-in-collision", "goal-in-collision"

Ending = Callable[[Clearance, Float64], Float64]
"""Function of an arm's clearance and a goal posture (J,) that returns free postures (W, J) up to that goal."""


@dataclass(frozen=True, kw_only=True)
class PlannedPath:
    """A timed path, or None with the reason in outcome.

    margin, self_margin [m]: reduced if start or goal has less clearance. seconds [s]: of planning.
    """

    outcome: str
    path: TimedPath | None
    clearance: Clearance
    margin: float
    self_margin: float
    num_edges: int
    num_proved: int
    seconds: float


def planned_path(
    model: RobotModel,
    scene: HasDistance,
    task: ReplayTask,
    planner: PlannerConfig,
    control: ControlConfig,
    *,
    ending: Ending | None = None,
) -> PlannedPath:
    """Plan a path from start to goal pose, within the controller's frame speeds.

    scene: lower bound of a 1-Lipschitz distance. Goal postures are sought from home, start and random guesses.
    ending: gives the end of the path.
    """
    began = time.perf_counter()
    start, frame = task.start, task.frame
    extra = scene_margin(model, control) - control.margin  # the spheres' deficit, if configured
    room = Clearance.of(model, scene, margin=extra)
    random = np.random.default_rng(planner.seed)
    drawn = random.uniform(model.lower, model.upper, (fixed.GOAL_GUESSES * planner.goal_postures, len(start)))
    guesses = np.vstack([model.middle if task.home is None else task.home, start, drawn])
    goals = goal_postures(model, frame, task.T_world_goal, guesses, control, at_most=planner.goal_postures)
    margin, own, outcome = np.nan, np.nan, NO_POSTURE
    if len(goals):
        margin, own, goals = _margins(room, start, goals, control)
        outcome = START_BLOCKED if len(goals) else GOAL_BLOCKED
    path, num_proved, num_edges = None, 0, 0
    if min(margin, own) > 0:
        room = Clearance.of(model, scene, margin=margin + extra, self_margin=own)
        outcome, way = _find(room, task, goals, ending, planner)
        if outcome is PlanOutcome.SOLVED:
            path = time_path(
                way,
                model.velocity_limit,
                planner.max_acceleration,
                max_rate=effector_rates(
                    model, way, frame, max_linear=control.max_linear_speed, max_angular=control.max_angular_speed
                ),
            )
            check = check_edges(room, way[:-1], way[1:], contact=planner.contact / 2)
            num_edges, num_proved = len(check.free_share), int(np.sum(check.is_free))
    return PlannedPath(
        outcome=outcome,
        path=path,
        clearance=room,
        margin=margin,
        self_margin=own,
        num_edges=num_edges,
        num_proved=num_proved,
        seconds=time.perf_counter() - began,
    )


def _find(
    room: Clearance, task: ReplayTask, goals: Float64, ending: Ending | None, planner: PlannerConfig
) -> tuple[PlanOutcome, Float64]:
    last = [goal[None] if ending is None else ending(room, goal) for goal in goals]
    before = np.array([way[0] for way in last])
    nearest_plan = path_to_nearest(room, np.clip(task.start, room.model.lower, room.model.upper), before, planner)
    if not nearest_plan.is_solved:
        return nearest_plan.outcome, nearest_plan.waypoints
    stretch = last[int(np.argmin(np.linalg.norm(before - nearest_plan.waypoints[-1], axis=1)))]
    return nearest_plan.outcome, np.concatenate([nearest_plan.waypoints, stretch[1:]])


def path_to_nearest(room: Clearance, start: Float64, goals: Float64, planner: PlannerConfig) -> Plan:
    """A path to the nearest goal (G, J) within `NEAREST_ITERATIONS`, else to any goal."""
    nearest = goals[np.argsort(np.linalg.norm(goals - start, axis=1), kind="stable")]
    few = replace(planner, max_iterations=min(fixed.NEAREST_ITERATIONS, planner.max_iterations))
    nearest_plan = plan(room, start, nearest[:1], few, seed=planner.seed)
    return nearest_plan if nearest_plan.is_solved else plan(room, start, nearest, planner, seed=planner.seed)


def _margins(room: Clearance, start: Float64, goals: Float64, control: ControlConfig) -> tuple[float, float, Float64]:
    """Margins that start and goals (G, J) keep, and these goals."""
    rows = room.rows(np.vstack([start, goals])) - fixed.START_ROOM
    num = len(room.moving)
    scene, own = rows[:, :num].min(axis=1), rows[:, num:].min(axis=1, initial=np.inf)
    margin, self_margin = min(control.margin, float(scene[0])), min(control.self_margin, float(own[0]))
    short = np.maximum(margin - scene[1:], self_margin - own[1:])
    if np.min(short) > 0:  # no goal has the start's margins: use the best goal's
        best = int(np.argmin(short))
        margin, self_margin = min(margin, float(scene[1 + best])), min(self_margin, float(own[1 + best]))
    keeps = (scene[1:] >= margin) & (own[1:] >= self_margin)
    return margin, self_margin, goals[keeps & ((scene[1:] > 0) & (own[1:] > 0))]


def planned_detours(
    model: RobotModel,
    scene_at: Callable[[int], HasDistance],
    frame: str,
    planner: PlannerConfig,
    control: ControlConfig,
    *,
    home: Float64 | None = None,
) -> PlanDetour:
    """A planner of detours by `planned_path`, in the scene of the stall's stamp."""

    def detour(stamp_ns: int, q: Float64, T_world_goal: Float64) -> Detour | None:
        task = ReplayTask(start=q, T_world_goal=T_world_goal, frame=frame, stamp_ns=stamp_ns, home=home)
        path = planned_path(model, scene_at(stamp_ns), task, planner, control).path
        return None if path is None else Detour(path=path, wait_distance=planner.wait_distance)

    return detour


def goal_postures(
    model: RobotModel, frame: str, T_world_goal: Float64, guesses: Float64, config: ControlConfig, *, at_most: int
) -> Float64:
    """Distinct postures (G, J) within limits that bring `frame` to a pose.

    They meet a tenth of the goal's tolerances, in order of the guesses. G is 0 to `at_most`.
    """
    postures: list[Float64] = []
    for guess in guesses:
        q = _solve(model, frame, T_world_goal, guess, config)
        if q is not None and all(np.max(np.abs(q - other)) > fixed.GOAL_DISTINCT for other in postures):
            postures.append(q)
        if len(postures) == at_most:
            break
    return np.array(postures).reshape(-1, len(model.lower))


def _solve(
    model: RobotModel, frame: str, T_world_goal: Float64, guess: Float64, config: ControlConfig
) -> Float64 | None:
    scale = 1.0 / np.repeat([fixed.GOAL_SHARE * config.goal_position, fixed.GOAL_SHARE * config.goal_rotation], 3)
    q, damping = np.clip(guess, model.lower, model.upper), fixed.GOAL_DAMPING
    error = scale * pose_error(model.frame_pose(q, frame), T_world_goal)
    for _ in range(fixed.GOAL_STEPS):
        if max(np.linalg.norm(error[:3]), np.linalg.norm(error[3:])) <= 1.0:
            return q
        J = scale[:, None] * model.frame_jacobian(q, frame)
        square = J.T @ J
        step = np.linalg.solve(square + damping * np.trace(square) * np.eye(len(q)), J.T @ error)
        step *= min(1.0, fixed.GOAL_LONGEST_STEP / max(float(np.max(np.abs(step))), 1e-12))
        following = np.clip(q + step, model.lower, model.upper)
        next_error = scale * pose_error(model.frame_pose(following, frame), T_world_goal)
        if np.linalg.norm(next_error) < np.linalg.norm(error):
            q, error, damping = following, next_error, max(damping / 10, 1e-9)
        else:
            damping *= 10
        if damping > 1e3:
            return None
    return None
