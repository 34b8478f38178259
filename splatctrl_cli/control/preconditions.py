"""Conditions for running a controller, and margin violations that no controller can prevent."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.control.audit import BallDistance, DistanceFunction, part_clearances
from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_if
from splatctrl_cli.records import Bool, DistanceField, Float64, Integers, UInt8
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import sphere_names


@dataclass(frozen=True, kw_only=True)
class StaticViolation:
    """A fixed sphere closer to the scene than the margin."""

    sphere: str
    clearance: float


def check_model(model: RobotModel) -> None:
    """Raise InputError for a robot without velocity limits or moving spheres."""
    refuse_if(
        not np.any(model.moving_spheres), "robot: no collision sphere moves with a joint", remedy="check --spheres"
    )
    joint = int(np.argmin(np.asarray(model.velocity_limit) > 0))  # the first without a limit
    refuse_if(
        not model.velocity_limit[joint] > 0,
        f"joint {model.joint_names[joint]}: expected a velocity limit above zero, "
        f"got {model.velocity_limit[joint]:g}",
        remedy="set it in the URDF's <limit velocity=...>",
    )


def check_coverage(model: RobotModel, config: ControlConfig) -> None:
    """Raise InputError if rows should compensate for uncovered surface that was not measured."""
    unknown = np.isnan(model.sphere_deficit) & np.asarray(model.moving_spheres)
    name = sphere_names(model.sphere_set)[int(np.argmax(unknown))]
    refuse_if(
        config.coverage == "margin" and np.any(unknown),
        f"control.coverage = margin: sphere {name}: expected a measured coverage of its body, got none",
        remedy="give a URDF whose collision geometry can be read, or set control.coverage = report",
    )


def checked_posture(model: RobotModel, q: Float64, *, what: str = "joint positions") -> Float64:
    """q as (J,) float64. Raises InputError for another size or a non-finite value."""
    posture, names = np.asarray(q, dtype=np.float64), model.joint_names
    refuse_if(
        posture.shape != (len(names),),
        f"{what}: expected {len(names)} joints ({', '.join(names)}), got shape {posture.shape}",
    )
    if not np.all(np.isfinite(posture)):
        joint = int(np.argmin(np.isfinite(posture)))
        raise InputError(f"{what}: joint {names[joint]} is {posture[joint]}, expected a finite angle")
    return posture


def check_within_limits(model: RobotModel, q: Float64, tolerance: float, what: str = "start") -> None:
    """Raise InputError for q (J,) outside the position limits by more than `tolerance` [rad]."""
    outside = np.maximum(q - model.upper, model.lower - q)
    worst = int(np.argmax(outside))
    refuse_if(
        outside[worst] > tolerance,
        f"{what}: joint {model.joint_names[worst]}: expected within [{model.lower[worst]:.4f}, "
        f"{model.upper[worst]:.4f}] rad, got {q[worst]:.4f}",
        remedy=f"choose another {'--start-time' if what == 'start' else what}, or check that the URDF is of this "
        "robot",
    )


def check_free(
    model: RobotModel, field: DistanceField, q: Float64, distance_to: DistanceFunction | None = None
) -> None:
    """Raise NotEvaluableError for a start q (J,) in collision.

    distance_to: exact distance; with it, link surfaces decide (`part_clearances`).
    """
    moving, distance = sphere_clearance(model, field, q, np.asarray(model.moving_spheres))
    if distance_to is not None and (distance < 0).any():
        distance = part_clearances(model, q[None], distance_to)[0][0]
    worst = int(np.argmin(np.where(np.isfinite(distance), distance, np.inf)))
    name = sphere_names(model.sphere_set)[moving[worst]]
    refuse_if(
        distance[worst] < 0,
        f"start: expected a posture free of collision, got sphere {name} {-distance[worst]:.4f} m deep in it",
        remedy="choose another --start-time, or check the robot's labels in the scene and --base",
        error=NotEvaluableError,
    )


def check_goal(model: RobotModel, T_world_goal: Float64) -> None:
    """Raise InputError for a goal that is no pose, or beyond the robot's reach."""
    refuse_if(
        np.shape(T_world_goal) != (4, 4) or not np.all(np.isfinite(T_world_goal)),
        "goal: expected a finite pose x,y,z,qx,qy,qz,qw",
    )
    distance = float(np.linalg.norm(T_world_goal[:3, 3] - model.base_position))
    where = ", ".join(f"{v:.3f}" for v in T_world_goal[:3, 3])
    refuse_if(
        distance > model.reach(),
        f"goal: expected within {model.reach():.3f} m of the base, got ({where}) at {distance:.3f} m",
        remedy="give a nearer --goal, or check --base and the world frame",
    )


def static_violations(
    model: RobotModel, field: DistanceField, q: Float64, margin: float | Float64
) -> tuple[StaticViolation, ...]:
    """Fixed spheres nearer to the scene than the margin [m], one or (S,), due to mounting."""
    if np.all(model.moving_spheres):
        return ()
    still, distance = sphere_clearance(model, field, q, ~np.asarray(model.moving_spheres))
    names, least = sphere_names(model.sphere_set), np.broadcast_to(margin, len(model.moving_spheres))
    return tuple(
        StaticViolation(sphere=names[s], clearance=float(d))
        for s, d in zip(still, distance, strict=True)
        if d < least[s]
    )


def sphere_clearance(model: RobotModel, field: DistanceField, q: Float64, chosen: Bool) -> tuple[Integers, Float64]:
    """Indices (M,) of chosen spheres and their surfaces' distances (M,) [m] at q (J,)."""
    index = np.flatnonzero(chosen)
    distance = field.query(np.ascontiguousarray(model.sphere_centers(q)[index]))[0]
    return index, distance - model.sphere_set.radii[index]


WasFree = Callable[[Float64], UInt8]
"""points (Q, 3) [m], world -> 1 (Q,) where their voxel was free in any earlier scene, else 0."""


class FixedParts:
    """First clearance of each fixed sphere, and the least with obstacles that arrived later.

    clearances: both [m], by sphere. A ball has arrived if it is over STATIC_CHANGE (MOUNTED_CHANGE near a mount) from
    all balls of the first scene, and nearer than the first clearance by as much. The last scene had it, too, and its
    voxel was free in an earlier one; else it fills a hole of the map. A link's triangles count where they are
    farther.
    """

    def __init__(self, model: RobotModel, near: float) -> None:
        """near [m]: spheres whose first clearance is less stand near their mount."""
        self._model, self._near = model, near
        self._still = np.flatnonzero(~np.asarray(model.moving_spheres))
        self._stood = self._new = np.zeros((0, 3))  # balls of the first scene; arrivals in the last scene
        names = sphere_names(model.sphere_set)
        self._names = [names[s] for s in self._still]
        self.clearances: dict[str, tuple[float, float]] = {}

    def look(self, distance_to: DistanceFunction, q: Float64, was_free: WasFree | None) -> None:
        """Add the next scene, at q (J,); was_free: None if unknown."""
        if not len(self._still):
            return
        centers = np.ascontiguousarray(self._model.sphere_centers(q)[self._still])
        own = distance_to(centers) - self._model.sphere_set.radii[self._still]
        is_first = not self.clearances
        if is_first:
            self.clearances = {name: (float(mine), float(mine)) for name, mine in zip(self._names, own, strict=True)}
        first = np.array([self.clearances[name][0] for name in self._names])
        change = np.where(first < self._near, fixed.MOUNTED_CHANGE, fixed.STATIC_CHANGE)
        came = own
        if isinstance(distance_to, BallDistance):
            if is_first:
                self._stood = np.asarray(distance_to.centers, np.float64)
            came = self._came(distance_to, centers, q, was_free, change)
        for name, value in zip(self._names, np.where(came < first - change, came, np.inf).tolist(), strict=True):
            before, least = self.clearances[name]
            self.clearances[name] = (before, min(least, value))

    def _came(
        self, balls: BallDistance, centers: Float64, q: Float64, was_free: WasFree | None, change: Float64
    ) -> Float64:
        """Clearance (M,) [m] of each sphere from balls that arrived, by its `change` (M,) [m]; else infinite."""
        model, least = self._model, np.full(len(centers), np.inf)
        radii = model.sphere_set.radii[self._still]
        away = np.linalg.norm(centers[:, None] - balls.centers, axis=2) - radii[:, None] - balls.radii
        near = np.flatnonzero(away.min(axis=0) < fixed.STATIC_REACH)
        places = np.asarray(balls.centers[near], np.float64)
        if was_free is not None and len(near):
            self._stood = np.concatenate([self._stood, places[was_free(places) == 0]])
        moved = np.array([np.linalg.norm(self._stood - place, axis=1).min(initial=np.inf) for place in places])
        owner = away[:, near].argmin(axis=0)
        has_come = moved > change[owner]
        before, self._new = self._new, places[has_come]
        for number in np.flatnonzero(has_come):
            last = np.linalg.norm(before - places[number], axis=1).min(initial=np.inf)
            has_come[number] = last <= fixed.MOUNTED_CHANGE
        for k in np.unique(owner[has_come]).tolist():
            chosen = near[(owner == k) & has_come]
            link = model.sphere_set.links[self._still[k]]
            gaps = model.surface_gaps(q[None], balls.centers[chosen], balls.radii[chosen], {link})
            least[k] = max(away[k, chosen].min(), gaps[link][0] if link in gaps else -np.inf)
        return least
