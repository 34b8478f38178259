"""Clearance bounds between two logged states, from both ends, refined where too low.

If sphere s travels at most L_s in between, its distance is never below ``(d_0s + d_1s - L_s) / 2``, d_0s and d_1s at
the ends, because exact distance is 1-Lipschitz. L_s follows from joint motion and `RobotModel.lever_arms`.
"""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import HALVED_DOWN_TO, MAX_HALVINGS
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.audit import DistanceFunction, part_clearances
from splatctrl_cli.records import Bool, Float64


@dataclass(frozen=True, kw_only=True)
class Reach:
    """Moving spheres (M,) of an arm and their travel.

    radii (M,) [m], with the uncovered surface; levers (M, J) [m per rad or m]; velocity_limit (J,) [1/s].
    """

    moving: "np.ndarray[tuple[int], np.dtype[np.intp]]"
    radii: Float64
    levers: Float64
    velocity_limit: Float64

    @classmethod
    def of(cls, model: ArmModel) -> "Reach":
        """Return the reach of a model's moving spheres."""
        moving = np.flatnonzero(model.moving_spheres)
        deficit = np.maximum(np.nan_to_num(np.asarray(model.sphere_deficit, np.float64)[moving]), 0.0)
        return cls(
            moving=moving,
            radii=np.asarray(model.sphere_set.radii, np.float64)[moving] + deficit,
            levers=model.lever_arms()[moving],
            velocity_limit=np.asarray(model.velocity_limit, np.float64),
        )


@dataclass(frozen=True, kw_only=True)
class Between:
    """Lower bounds (T - 1,) [m] of the clearance within intervals, ends included.

    Where is_met (T - 1,), lower is a witness: the clearance of a posture in between, below the margin. is_bounded (T
    - 1,): False if the states do not determine a bound.
    """

    lower: Float64
    is_met: Bool
    is_bounded: Bool


def between_states(
    model: ArmModel,
    reach: Reach,
    stamps: "np.ndarray[tuple[int], np.dtype[np.int64]]",
    positions: Float64,
    velocities: Float64,
    at_states: Float64,
    distance_to: DistanceFunction,
    *,
    margin: float,
    longest: float,
) -> Between:
    """Return bounds between states (T, J) at stamps (T,) [ns] in one scene.

    at_states (T, M) [m]: moving spheres' `clearances`, infinite for intended contact. Up to `longest` [s] the arm is
    assumed to move straight in joint space, plus any excess of its velocities (T, J). Over longer intervals it may
    have gone anywhere within its velocity limits: bounded only where that stays above the margin [m].
    """
    seconds = np.diff(stamps) * 1e-9
    motion = np.abs(np.diff(positions, axis=0))
    speed = 0.5 * (np.abs(velocities[1:]) + np.abs(velocities[:-1])) * seconds[:, None]
    straight = motion @ reach.levers.T
    beyond = np.maximum(np.where(np.isfinite(speed), speed, 0.0) - motion, 0.0) @ reach.levers.T
    first, last = at_states[:-1], at_states[1:]
    is_long = seconds > longest + 1e-6
    anywhere = seconds[:, None] * reach.velocity_limit @ reach.levers.T
    travel = np.where(is_long[:, None], np.maximum(anywhere, straight), straight)
    lower = 0.5 * (first + last - travel - beyond)
    ends = np.minimum(first.min(axis=1), last.min(axis=1))
    is_open = ~is_long & (lower.min(axis=1) < margin) & (ends >= margin)
    least = np.minimum(lower.min(axis=1), ends)
    chosen = np.flatnonzero(is_open)
    is_met = np.zeros(len(least), dtype=np.bool_)
    if len(chosen):
        refined, is_met[chosen] = _refined(
            model, reach, positions[chosen], positions[chosen + 1], first[chosen], last[chosen], distance_to, margin
        )
        away = np.where(is_met[chosen], 0.0, 0.5 * beyond[chosen].max(axis=1))
        least[chosen] = np.minimum(refined - away, ends[chosen])
    short = ~is_long & ~is_open & (ends < margin)
    least[short] = ends[short]  # the ends are below the margin already
    is_bounded = np.isfinite(least) & (~is_long | (least >= margin) | (ends < margin))
    return Between(lower=least, is_met=is_met, is_bounded=is_bounded)


def _refined(
    model: ArmModel,
    reach: Reach,
    q_first: Float64,
    q_last: Float64,
    first: Float64,
    last: Float64,
    distance_to: DistanceFunction,
    margin: float,
) -> tuple[Float64, Bool]:
    """Halve K straight motions until each piece's bound reaches the margin, or the piece is short.

    Return the least bound (K,), and is_met (K,): a posture on the way is below the margin, and the least clearance of
    such postures replaces the bound.
    """
    least, is_met = np.full(len(q_first), np.inf), np.zeros(len(q_first), dtype=np.bool_)
    owner = np.arange(len(q_first))
    for level in range(MAX_HALVINGS + 1):
        travel = np.abs(q_last - q_first) @ reach.levers.T
        bound = (0.5 * (first + last - travel)).min(axis=1)
        is_done = (bound >= margin) | (travel.max(axis=1) < HALVED_DOWN_TO) | (level == MAX_HALVINGS)
        np.minimum.at(least, owner[is_done], bound[is_done])
        open_ = np.flatnonzero(~is_done)
        if not len(open_):
            break
        middle = 0.5 * (q_first[open_] + q_last[open_])
        at_middle = clearances(model, reach, middle, distance_to)
        at_middle[np.isposinf(first[open_]) | np.isposinf(last[open_])] = (
            np.inf
        )  # excluded at an end: also in between
        reached = at_middle.min(axis=1) < margin  # a sample below the margin settles its interval
        is_first = reached & ~is_met[owner[open_]]
        least[owner[open_[is_first]]] = np.inf  # drop the bounds of settled pieces
        is_met[owner[open_[reached]]] = True
        np.minimum.at(least, owner[open_[reached]], at_middle[reached].min(axis=1))
        settled = np.isin(owner[open_], owner[open_[reached]])
        keep = open_[~settled]
        middle, at_middle = middle[~settled], at_middle[~settled]
        q_first, q_last = np.concatenate([q_first[keep], middle]), np.concatenate([middle, q_last[keep]])
        first, last = np.concatenate([first[keep], at_middle]), np.concatenate([at_middle, last[keep]])
        owner = np.concatenate([owner[keep], owner[keep]])
    return least, is_met


def clearances(model: ArmModel, reach: Reach, positions: Float64, distance_to: DistanceFunction) -> Float64:
    """Return moving spheres' clearances (T, M) [m], less their uncovered surface."""
    each, is_surface = part_clearances(model, positions, distance_to)
    return np.asarray(each - np.where(is_surface, 0.0, reach.radii - model.sphere_set.radii[reach.moving]))
