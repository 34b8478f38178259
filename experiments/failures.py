"""Why a trial of Table II failed, as a picture: the place of contact, stall or block, and the map there."""

from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np

from experiments import judge
from experiments import pictures as drawn
from experiments.problems import Problem, Views
from splatctrl_cli.blocks import Float32, Float64, HasDistance, RobotSurface, Shape, pose_at, sphere_names

CLOSE, FAR = 0.50, 2.3  # [m] of the two views from what they look at
POINTS = 150  # of the tip's way, at most
BALLS = 6000  # of the map, at most: the seconds that a picture takes go with them
DIRECTIONS = 300  # that are tried for a view


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A trial without success: its label, cause, verdict and reason. position (T, J): None if nothing was driven.
    things: the map's balls, centers (N, 3) and radii (N,) [m]. scene: distance to the map. Both are None without a
    map.
    """

    problem: Problem
    views: Views
    told: str
    cause: str
    verdict: str
    reason: str
    position: Float64 | None
    scene: HasDistance | None
    things: tuple[Float32, Float32] | None


def draw(failure: Failure, path: Path) -> None:
    """Write two views of a failure: one from afar, one close to its place with a free line of sight."""
    at, eyes = _place(failure), np.array([frame.T_world_camera[:3, 3] for frame in failure.views.steps[0]])
    middle = np.mean([at.point, failure.problem.model.base_position, eyes.mean(axis=0)], axis=0)
    views = [
        ("from afar", middle + FAR * _free_direction(failure, at, FAR), middle),
        ("close up", at.point + CLOSE * _free_direction(failure, at, CLOSE), at.point),
    ]
    drawn.trial_picture(path, _scene(failure, at, eyes), views, _caption(failure, at))


def _scene(failure: Failure, at: judge.Contact, eyes: Float64) -> drawn.TrialScene:
    """Things, the arm at the place and the tip's way; the map, the start and the goal shine through."""
    problem, model = failure.problem, failure.problem.model
    centers, radii = model.sphere_centers(at.q), model.sphere_set.radii
    driven = at.q[None] if failure.position is None else failure.position
    way = [model.frame_pose(q, model.frame_names[-1])[:3, 3] for q in driven[:: -(-len(driven) // POINTS)]]
    others = np.arange(len(radii)) != at.sphere
    solid = [Shape(link=drawn.THING, kind=p.kind, size=p.size, T_link_shape=p.T_world_shape) for p in problem.things]
    solid += _balls(drawn.ARM, centers[others], radii[others])
    solid += _balls(drawn.TOUCHED, centers[[at.sphere]], radii[[at.sphere]])
    solid += _balls(drawn.WAY, np.array(way), np.full(len(way), 0.004))
    solid += _balls(drawn.CAMERA, eyes, np.full(len(eyes), 0.03))
    light = [] if failure.things is None else [_balls(drawn.MAP, *_shown(problem, *failure.things))]
    light += [
        _balls(name, model.sphere_centers(q), radii)
        for name, q in ((drawn.START, problem.start), (drawn.GOAL, problem.goal))
    ]
    return drawn.TrialScene(
        solid=RobotSurface.from_parts(solid),
        light=[RobotSurface.from_parts(balls) for balls in light],
        is_seen=failure.views.has_seen,
        place=at.point,
        cameras=eyes,
    )


def _shown(problem: Problem, centers: Float32, radii: Float32) -> tuple[Float32, Float32]:
    """At most `BALLS` of balls (N, 3), (N,): evenly chosen, by their order, from balls that the arm reaches."""
    is_near = np.linalg.norm(centers - problem.model.base_position, axis=1) < problem.model.reach()
    number = np.flatnonzero(is_near)
    kept = number[:: max(-(-len(number) // BALLS), 1)]
    return centers[kept], radii[kept]


def _balls(link: str, centers: Float32 | Float64, radii: Float32 | Float64) -> list[Shape]:
    return [
        Shape(link=link, kind="sphere", size=(float(radius),), T_link_shape=pose_at(center))
        for center, radius in zip(centers, radii, strict=True)
    ]


def _place(failure: Failure) -> judge.Contact:
    """The deepest contact with the truth; else the sphere nearest to the map at the arm's end or blocked posture."""
    problem = failure.problem
    if failure.position is not None and failure.cause in (judge.HIT_SEEN, judge.HIT_UNSEEN, judge.HIT_SELF):
        return judge.deepest_contact(problem, failure.position)
    when, q = "at the goal", problem.goal
    if failure.position is not None:
        when, q = "where it ended", failure.position[-1]
    elif failure.cause == judge.START_BLOCKED:
        when, q = "at the start", problem.start
    centers = problem.model.sphere_centers(q)
    moving = np.flatnonzero(problem.model.moving_spheres)
    away = (failure.scene or problem.solids).distance(centers[moving]) - problem.model.sphere_set.radii[moving]
    sphere = int(moving[np.argmin(away)])
    return judge.Contact(q=q, sphere=sphere, point=centers[sphere], when=when)


def _free_direction(failure: Failure, at: judge.Contact, length: float) -> Float64:
    """Direction (3,) with the freest view of the place, past objects and arm, and across the contact's direction."""
    number = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - 1.3 * number / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * number  # not from below
    across = np.sqrt(1 - height**2)
    directions = np.column_stack([across * np.cos(turn), across * np.sin(turn), height])
    model = failure.problem.model
    center, radius = model.sphere_centers(at.q)[at.sphere], float(model.sphere_set.radii[at.sphere])
    steps = np.linspace(radius + 0.02, length, 40)
    points = (at.point + steps[:, None, None] * directions).reshape(-1, 3)
    away = failure.problem.solids.distance(points)
    others = np.arange(len(model.sphere_set.radii)) != at.sphere
    arm = [
        np.linalg.norm(points - c, axis=1) - r
        for c, r in zip(model.sphere_centers(at.q)[others], model.sphere_set.radii[others], strict=True)
    ]
    room = np.minimum(away, np.min(arm, axis=0)).reshape(len(steps), -1)
    is_open = np.mean(room > 0, axis=0) + np.clip(room.min(axis=0), -0.05, 0.05)
    facing = (at.point - center) / max(float(np.linalg.norm(at.point - center)), 1e-9)
    return np.asarray(directions[np.argmax(is_open - 0.05 * np.abs(directions @ facing))])


def _caption(failure: Failure, at: judge.Contact) -> str:
    """Text: trial, cause, verdict, and the sphere's distances from objects by truth and map."""
    problem, model = failure.problem, failure.problem.model
    center, radius = model.sphere_centers(at.q)[[at.sphere]], float(model.sphere_set.radii[at.sphere])
    name = sphere_names(model.sphere_set)[at.sphere]
    gaps = [("true", problem.solids), *([("in the map", failure.scene)] if failure.scene is not None else [])]
    said = ", ".join(f"{1e3 * float(scene.distance(center)[0] - radius):.1f} mm {what}" for what, scene in gaps)
    where = ", ".join(f"{value:.2f}" for value in at.point)
    verdict = f"{failure.verdict or 'no verdict'}{': ' if failure.reason else ''}{failure.reason}"
    which = f"{at.when}: sphere {name} at ({where}) m; to things {said}"
    return f"{failure.told}: {failure.cause}\n{shorten(verdict, 150)}\n{which}"
