"""Obstacles that approach fixed links; obstacles of the first scene do not count."""

from collections.abc import Callable

import numpy as np

from splatctrl_cli.config.fixed import MOUNTED_CHANGE, STATIC_CHANGE, STATIC_REACH
from splatctrl_cli.control.arm import ArmModel, sphere_names
from splatctrl_cli.control.audit import BallDistance, DistanceFunction
from splatctrl_cli.records import Bool, Float64

WasSeen = Callable[[Float64], Bool]
"""points (Q, 3) [m], world -> whether (Q,) any camera had seen them before."""


class FixedParts:
    """`found`: each fixed sphere's clearance [m] in the first scene, and its least, later arrivals included.

    A ball has arrived if none of the first scene stood within STATIC_CHANGE of it; near a sphere at its mount, where
    the map grows, within MOUNTED_CHANGE. It is nearer than the first clearance by as much, and a camera had seen its
    place before. The last scene had it too: noise is in one scene alone. A link's triangles count where they are
    farther away.
    """

    def __init__(self, model: ArmModel, near: float) -> None:
        """near [m]: spheres with less first clearance stand near their mount."""
        self._model, self._near = model, near
        self._still = np.flatnonzero(~np.asarray(model.moving_spheres))
        self._stood = self._new = np.zeros((0, 3))  # of the first scene; arrivals in the last one
        names = sphere_names(model.sphere_set)
        self._names = [names[s] for s in self._still]
        self.found: dict[str, tuple[float, float]] = {}

    def look(self, distance_to: DistanceFunction, q: Float64, was_seen: WasSeen | None) -> None:
        """Add the next scene, at q (J,). was_seen: None if unknown."""
        if not len(self._still):
            return
        centers = np.ascontiguousarray(self._model.sphere_centers(q)[self._still])
        own = distance_to(centers) - self._model.sphere_set.radii[self._still]
        is_first = not self.found
        if is_first:
            self.found = {name: (float(mine), float(mine)) for name, mine in zip(self._names, own, strict=True)}
        first = np.array([self.found[name][0] for name in self._names])
        change = np.where(first < self._near, MOUNTED_CHANGE, STATIC_CHANGE)
        came = own
        if isinstance(distance_to, BallDistance):
            if is_first:
                self._stood = np.asarray(distance_to.centers, np.float64)
            came = self._came(distance_to, centers, q, was_seen, change)
        for name, value in zip(self._names, np.where(came < first - change, came, np.inf).tolist(), strict=True):
            before, least = self.found[name]
            self.found[name] = (before, min(least, value))

    def _came(
        self, balls: BallDistance, centers: Float64, q: Float64, was_seen: WasSeen | None, change: Float64
    ) -> Float64:
        """Clearance (M,) [m] of each sphere from balls that moved by over `change` (M,) [m]; infinite without any."""
        model, least = self._model, np.full(len(centers), np.inf)
        radii = model.sphere_set.radii[self._still]
        away = np.linalg.norm(centers[:, None] - balls.centers, axis=2) - radii[:, None] - balls.radii
        near = np.flatnonzero(away.min(axis=0) < STATIC_REACH)
        places = np.asarray(balls.centers[near], np.float64)
        if was_seen is not None and len(near):
            is_new_place = ~was_seen(places)
            self._stood = np.concatenate([self._stood, places[is_new_place]])
        moved = np.array([np.linalg.norm(self._stood - place, axis=1).min(initial=np.inf) for place in places])
        owner = away[:, near].argmin(axis=0)
        has_come = moved > change[owner]
        before, self._new = self._new, places[has_come]
        for number in np.flatnonzero(has_come):
            last = np.linalg.norm(before - places[number], axis=1).min(initial=np.inf)
            has_come[number] = last <= MOUNTED_CHANGE
        for k in np.unique(owner[has_come]).tolist():
            chosen = near[(owner == k) & has_come]
            link = model.sphere_set.links[self._still[k]]
            gaps = model.surface_gaps(q[None], balls.centers[chosen], balls.radii[chosen], {link})
            least[k] = max(away[k, chosen].min(), gaps[link][0] if link in gaps else -np.inf)
        return least
