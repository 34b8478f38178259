"""Clearance of many postures and motions in a scene, and proofs of free edges.

B postures, J joints; R rows: moving spheres, then pairs of spheres.
"""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from splatctrl_cli.config.fixed import SHORTEST_EDGE, STILL_ROW
from splatctrl_cli.errors import NotEvaluableError, refuse_if
from splatctrl_cli.kernels.chain import EdgeRoom
from splatctrl_cli.records import Bool, Float64, Integers
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import sphere_names


class HasDistance(Protocol):
    """A scene with distance but no gradient."""

    def distance(self, points: Float64) -> Float64:
        """Signed distance (Q,) [m] at points (Q, 3) [m], world."""


@runtime_checkable
class SolidScene(HasDistance, Protocol):
    """A scene of solids, among which a kernel proves edges."""

    def rows(self) -> tuple[Float64, Float64, Float64]:
        """Balls (., 4), boxes (., 15) and rods (., 15), as `EdgeRoom.among` takes them."""


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """Signed distances of an arm's spheres to a scene and each other, less margins.

    taken (R,) [m]: radii plus margins. moving (M,), pairs (P, 2): indices of spheres. levers (R, J): a motion dq
    lowers a row by at most ``levers @ |dq|`` [m], if the scene's distance is 1-Lipschitz (else `lipschitz` scales its
    rows). compiled: kernel for edges in a `SolidScene`, None without a chain.
    """

    model: RobotModel
    scene: HasDistance
    taken: Float64
    moving: Integers
    pairs: Integers
    levers: Float64
    names: tuple[str, ...]
    compiled: EdgeRoom | None = None

    @classmethod
    def of(
        cls,
        model: RobotModel,
        scene: HasDistance,
        *,
        margin: float | Float64 = 0.0,
        self_margin: float = 0.0,
        lipschitz: float = 1.0,
    ) -> "Clearance":
        """An arm's clearance in a scene.

        margin [m]: to the scene, one number or (S,). self_margin [m]: between spheres, less the model's allowance.
        Raises InputError if no sphere moves.
        """
        moving = np.flatnonzero(model.moving_spheres)
        refuse_if(not len(moving), "robot: no collision sphere moves with a joint", remedy="check --spheres")
        levers, pairs = model.lever_arms(), np.asarray(model.self_pairs()).reshape(-1, 2)
        names, radii = sphere_names(model.sphere_set), np.asarray(model.sphere_set.radii, dtype=np.float64)
        own = radii[pairs].sum(axis=1) + self_margin - model.self_allowance
        taken = np.concatenate([(radii + margin)[moving], own])
        rows = np.concatenate([lipschitz * levers[moving], _between(levers, pairs)])
        chain, which = model.chain, (moving.astype(np.int64), pairs.astype(np.int64))
        compiled = None if chain is None else EdgeRoom.of(chain, *which, taken, rows)
        room = cls(
            model=model,
            scene=scene,
            taken=taken,
            moving=moving,
            pairs=pairs,
            levers=rows,
            compiled=compiled,
            names=tuple(names[s] for s in moving) + tuple(f"{names[a]}~{names[b]}" for a, b in pairs),
        )
        return room.replace_scene(scene)

    def replace_scene(self, scene: HasDistance) -> "Clearance":
        """Same arm and margins in another scene."""
        if self.compiled is None or not isinstance(scene, SolidScene):
            return replace(self, scene=scene)
        return replace(self, scene=scene, compiled=self.compiled.among(*scene.rows()))

    def rows(self, q: Float64) -> Float64:
        """Distances less margins (B, R) [m] at q (B, J).

        Raises NotEvaluableError where the scene has no distance.
        """
        centers = self.model.sphere_centers_batch(q)
        points = np.ascontiguousarray(centers[:, self.moving]).reshape(-1, 3)
        distance = self.scene.distance(points)
        is_missing = np.isnan(distance)
        if np.any(is_missing):
            first = int(np.argmax(is_missing))
            where = ", ".join(f"{v:.3f}" for v in points[first])
            raise NotEvaluableError(
                f"sphere {self.names[first % len(self.moving)]} at ({where}) m: the field has no distance there",
                remedy="bake a field that covers the robot's reach",
            )
        num_moving = len(self.moving)
        rows = np.empty((len(q), len(self.names)))
        rows[:, :num_moving] = distance.reshape(len(q), -1)
        if len(self.pairs):
            rows[:, num_moving:] = _apart(centers, self.pairs)
        rows -= self.taken
        return rows

    def at(self, q: Float64) -> Float64:
        """Least row (B,) [m] at q (B, J)."""
        return np.asarray(np.min(self.rows(q), axis=1))

    def speeds(self, motion: Float64) -> Float64:
        """Largest loss (E, R) [m] over motions dq (E, J)."""
        return np.asarray(np.abs(motion) @ self.levers.T)

    def worst(self, q: Float64) -> tuple[str, float]:
        """Least row's name and value [m] at q (J,)."""
        row = self.rows(q[None])[0]
        return self.names[int(np.argmin(row))], float(np.min(row))


def _apart(centers: Float64, pairs: Integers) -> Float64:
    B, S = centers.shape[:2]
    squares = np.einsum("bsk,bsk->bs", centers, centers)
    apart = centers @ np.swapaxes(-2.0 * centers, 1, 2)
    apart += squares[:, :, None]
    apart += squares[:, None, :]
    chosen = np.take(apart.reshape(B, -1), pairs[:, 0] * S + pairs[:, 1], axis=1)
    return np.asarray(np.sqrt(np.maximum(chosen, 0.0, out=chosen), out=chosen))


def _between(levers: Float64, pairs: Integers) -> Float64:
    a, b = levers[pairs[:, 0]], levers[pairs[:, 1]]
    moves_both: Bool = (a > 0) & (b > 0)
    return np.where(moves_both, 0.0, np.maximum(a, b))


ROUNDING = 1e-9  # [m] subtracted from every clearance: far above rounding


@dataclass(frozen=True, kw_only=True)
class EdgeCheck:
    """Proofs of E edges: each is free up to a share `free_share` (E,) of its length.

    num_checks: postures checked.
    """

    free_share: Float64
    num_checks: int

    @property
    def is_free(self) -> Bool:
        """True (E,) for wholly free edges."""
        return self.free_share >= 1.0


def check_edges(
    clearance: Clearance,
    start: Float64,
    end: Float64,
    *,
    contact: float,
    give_up: float = 0.0,
    only_whole: bool = True,
) -> EdgeCheck:
    """Prove edges start (E, J) to end (E, J) free.

    Clearance below `contact` [m] counts as collision. The last `give_up` [rad] before a collision may stay unproved.
    With `only_whole`, a collision sets an edge's free_share to 0.
    """
    if clearance.compiled is None or not isinstance(clearance.scene, SolidScene):
        return check_sampled_edges(clearance, start, end, contact=contact, give_up=give_up, only_whole=only_whole)
    share, num_checks = clearance.compiled.advance(
        start,
        end,
        contact=contact,
        give_up=max(give_up, SHORTEST_EDGE),
        rounding=ROUNDING,
        still=STILL_ROW,
        only_whole=only_whole,
    )
    return EdgeCheck(free_share=share, num_checks=int(num_checks.sum()))


def check_sampled_edges(
    clearance: Clearance, start: Float64, end: Float64, *, contact: float, give_up: float, only_whole: bool
) -> EdgeCheck:
    """Prove edges in any scene by `Clearance.rows`; the kernel's oracle."""
    motion = end - start
    speeds = np.maximum(clearance.speeds(motion), STILL_ROW)
    length = np.linalg.norm(motion, axis=1)
    free = np.ones(len(start))
    edge, low, high = np.arange(len(start)), np.zeros(len(start)), np.ones(len(start))
    num_checks = 0
    while len(edge):
        middle = (low + high) / 2
        rows = clearance.rows(start[edge] + middle[:, None] * motion[edge]) - ROUNDING
        num_checks += len(edge)
        covered = np.min(rows / speeds[edge], axis=1)
        is_hit = np.min(rows, axis=1) < contact
        covered[is_hit] = 0.0
        np.minimum.at(free, edge[is_hit], 0.0 if only_whole else middle[is_hit])
        edge = np.concatenate([edge, edge])
        low, high = np.concatenate([low, middle + covered]), np.concatenate([middle - covered, high])
        high = np.minimum(high, free[edge])
        is_open = low < high
        is_last = (high >= free[edge]) & (free[edge] < 1.0)  # the part before a collision
        is_short = is_open & is_last & ((high - low) * length[edge] < max(give_up, SHORTEST_EDGE))
        np.minimum.at(free, edge[is_short], 0.0 if only_whole else low[is_short])
        keep = is_open & ~is_short & (low < free[edge])
        edge, low, high = edge[keep], low[keep], high[keep]
    return EdgeCheck(free_share=free, num_checks=num_checks)
