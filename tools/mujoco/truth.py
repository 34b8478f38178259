"""The exact clearance of a robot's surfaces from all solids, at any state of a recording.

A surface is triangles by link, grouped in patches. Halving a triangle finds the least distance of a solid over it. A
convex solid's distance is a convex function, which its tangent at the triangle's middle bounds from below. A lathe is
a stack of convex frusta; inside it, the triangle's radius gives the bound.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from tools.mujoco.cell import COLLIDES, Cell, as_piece
from tools.mujoco.poses import Float64, inverse, moved
from tools.mujoco.robots import Piece, Robot, load_robot
from tools.mujoco.solids import CONVEX, Solid, Track, frusta, signed_distance

REACH = 0.30  # [m] distances beyond are left at it
TOLERANCE = 5e-5  # [m]
PATCH = 48  # triangles at most
STATES = 64  # at once
MANY = 4_000_000  # cells of a lathe's search, beyond which it is not refined


@dataclass(frozen=True, kw_only=True)
class Body:
    """Triangles (F, 3, 3) [m] in one frame, sorted by patch, with each patch's first triangle, middle and radius."""

    triangles: Float64
    first: NDArray[np.int64]
    middles: Float64
    radii: Float64

    @classmethod
    def of(cls, pieces: Sequence[Piece]) -> "Body":
        """Cut at the median of the longest side until patches are small."""
        triangles = np.concatenate([piece.triangles for piece in pieces])
        patches, rest = [], [np.arange(len(triangles))]
        centroids = triangles.mean(axis=1)
        while rest:
            mine = rest.pop()
            if len(mine) <= PATCH:
                patches.append(mine)
                continue
            axis = int(np.argmax(np.ptp(centroids[mine], axis=0)))
            order = mine[np.argsort(centroids[mine, axis], kind="stable")]
            rest += [order[: len(order) // 2], order[len(order) // 2 :]]
        middles = np.array([triangles[mine].reshape(-1, 3).mean(axis=0) for mine in patches])
        radii = np.array(
            [
                np.linalg.norm(triangles[m].reshape(-1, 3) - c, axis=1).max()
                for m, c in zip(patches, middles, strict=True)
            ]
        )
        first = np.concatenate([[0], np.cumsum([len(mine) for mine in patches])])
        return cls(triangles=triangles[np.concatenate(patches)], first=first, middles=middles, radii=radii)


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """Least signed distance (T,) [m], its link and solid, and `per` (T, S) of each solid, up to `REACH`."""

    least: Float64
    link: tuple[str, ...]
    solid: tuple[str, ...]
    per: Float64


def clearance_of(
    bodies: Mapping[str, Body], poses: Mapping[str, Float64], solids: Sequence[Solid], times: Float64
) -> Clearance:
    """Clearance of bodies by link, at poses (T, 4, 4), from solids at times (T,) [s]."""
    names = list(bodies)
    per = np.full((len(times), len(solids)), REACH)
    who = np.full((len(times), len(solids)), -1)
    for column, solid in enumerate(solids):
        T_solid_world = inverse(solid.track.at(times))
        for number, name in enumerate(names):
            for start in range(0, len(times), STATES):
                rows = slice(start, start + STATES)
                T, best = T_solid_world[rows] @ poses[name][rows], per[rows, column]
                before = best.copy()
                for part in frusta(solid) if solid.kind == "lathe" else (solid,):
                    _lower(bodies[name], T, part, best)
                if solid.kind == "lathe":
                    deep = np.flatnonzero((best < 0) & (best < before))
                    exact = best[deep]
                    _lower(bodies[name], T[deep], solid, exact)
                    best[deep] = exact
                who[rows, column][best < before] = number
    best = np.argmin(per, axis=1)
    rows_all = np.arange(len(times))
    return Clearance(
        least=per[rows_all, best],
        link=tuple(names[n] if n >= 0 else "" for n in who[rows_all, best]),
        solid=tuple(solids[s].name if n >= 0 else "" for s, n in zip(best, who[rows_all, best], strict=True)),
        per=per,
    )


def _lower(body: Body, T: Float64, solid: Solid, best: Float64) -> None:
    """Lower `best` (T,) to a body's distance, if less; T (T, 4, 4) maps the body's frame to the solid's."""
    middles = np.einsum("tij,pj->tpi", T[:, :3, :3], body.middles) + T[:, None, :3, 3]
    away = _distances(solid, middles)
    np.minimum(best, (away + body.radii).min(axis=1), out=best)
    state, patch = np.nonzero(away - body.radii < best[:, None])
    if len(state) == 0:
        return
    counts = np.diff(body.first)[patch]
    index = (
        np.repeat(body.first[patch], counts) + np.arange(counts.sum()) - np.repeat(counts.cumsum() - counts, counts)
    )
    state = np.repeat(state, counts)
    cells = np.einsum("mij,mkj->mki", T[state, :3, :3], body.triangles[index]) + T[state, None, :3, 3]
    while len(cells) and len(cells) < MANY:
        middle = cells.mean(axis=1)
        distance, slope = signed_distance(solid, middle)
        np.minimum.at(best, state, distance)
        offset = cells - middle[:, None]
        if solid.kind in CONVEX:
            bound = distance + np.einsum("mki,mi->mk", offset, slope).min(axis=1)
        else:
            bound = distance - np.linalg.norm(offset, axis=2).max(axis=1)
        is_open = bound < best[state] - TOLERANCE * (1 if solid.kind in CONVEX else 4)
        a, b, c = np.moveaxis(cells[is_open], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        cells = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
        state = np.tile(state[is_open], 4)


def _distances(solid: Solid, points: Float64) -> Float64:
    """Signed distances (...,) of points (..., 3)."""
    return signed_distance(solid, points.reshape(-1, 3))[0].reshape(points.shape[:-1])


@dataclass(frozen=True, kw_only=True)
class World:
    """A robot and the solids about it over time."""

    robot: Robot
    solids: tuple[Solid, ...]

    @property
    def obstacles(self) -> tuple[Solid, ...]:
        """Solids that never move with the robot."""
        return tuple(solid for solid in self.solids if solid.link is None and solid.held is None)

    def seen(self) -> dict[str, Body]:
        """The visual surface of each moving link, with the solids fixed to it."""
        pieces = {link: list(found) for link, found in self.robot.visual.items()}
        for solid in self.solids:
            if solid.link is not None:
                piece = as_piece(solid)
                vertices = moved(solid.track.poses[0], piece.vertices)
                pieces[solid.link].append(Piece(vertices=vertices, faces=piece.faces, rgb=piece.rgb))
        return self._moving(pieces)

    def colliding(self) -> dict[str, Body]:
        """The surface of each moving link's collision geometry."""
        return self._moving(self.robot.collision)

    def clearances(self, times: Float64, q: Float64) -> tuple[Clearance, Clearance]:
        """Clearance of the visible and of the collision surface, at times (T,) [s] and joint positions (T, J)."""
        poses = Cell(self.robot, (), ()).link_poses(q)
        seen = clearance_of(self.seen(), poses, self.obstacles, times)
        for solid in self.solids:
            if solid.held is not None:
                rows = np.flatnonzero((times >= solid.held[0]) & (times <= solid.held[1]))
                held = clearance_of(
                    {solid.name: Body.of([as_piece(solid)])}, {solid.name: solid.track.at(times[rows])},
                    self.obstacles, times[rows],
                )  # fmt: skip
                seen = _joined(seen, held, rows)
        if self.robot.collision is self.robot.visual and not any(s.link or s.held for s in self.solids):
            return seen, seen
        return seen, clearance_of(self.colliding(), poses, self.obstacles, times)

    def _moving(self, pieces: Mapping[str, Sequence[Piece]]) -> dict[str, Body]:
        still = self.robot.fixed_links
        return {link: Body.of(found) for link, found in pieces.items() if found and link not in still}


def _joined(seen: Clearance, held: Clearance, rows: NDArray[np.int64]) -> Clearance:
    """With the nearer of the two in some rows."""
    per, link, solid = seen.per.copy(), list(seen.link), list(seen.solid)
    least = seen.least.copy()
    per[rows] = np.minimum(per[rows], held.per)
    for k, row in enumerate(rows):
        if held.least[k] < least[row]:
            least[row], link[row], solid[row] = held.least[k], held.link[k], held.solid[k]
    return Clearance(least=least, link=tuple(link), solid=tuple(solid), per=per)


def mujoco_difference(world: World, time: float, q: Float64) -> float:
    """The greatest |difference| [m] between MuJoCo's distances and these, over untouched convex solids.

    Both use convex hulls of collision meshes, because MuJoCo does.
    """
    cell = Cell(world.robot, world.obstacles, ())
    cell.place(q, time)
    poses = cell.link_poses(q[None])
    hulls = {
        link: Body.of([_hull(piece) for piece in pieces])
        for link, pieces in world.robot.collision.items()
        if pieces and link not in world.robot.fixed_links
    }
    worst = 0.0
    for solid in (s for s in world.obstacles if s.kind in CONVEX):
        ours = clearance_of(hulls, poses, [solid], np.array([time])).least[0]
        if not 0.002 < ours < 0.25:
            continue
        geoms = cell.geoms_of(list(hulls), COLLIDES)
        other = cell.model.geom(f"solid.{solid.name}").id
        theirs = min(mujoco.mj_geomDistance(cell.model, cell.data, int(g), other, 1.0, None) for g in geoms)
        worst = max(worst, abs(theirs - ours))
    return worst


def _hull(piece: Piece) -> Piece:
    hull = trimesh.convex.convex_hull(piece.vertices)
    return Piece(vertices=np.asarray(hull.vertices), faces=np.asarray(hull.faces, np.int32), rgb=piece.rgb)


def clearances(folder: Path, t: Float64, q: Float64) -> tuple[Float64, Float64]:
    """Clearance (T,) [m] of the visual and of the collision geometry, for a motion driven in a recording's world."""
    seen, colliding = load_world(folder).clearances(np.asarray(t, np.float64), np.asarray(q, np.float64))
    return seen.least, colliding.least


def load_world(folder: Path) -> World:
    """The world of a recording, from its truth.json."""
    document = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    return World(robot=load_robot(document["robot"]), solids=tuple(_solid(entry) for entry in document["solids"]))


def solid_document(solid: Solid) -> dict[str, object]:
    """A solid as plain JSON values."""
    return {
        "name": solid.name,
        "kind": solid.kind,
        "size": list(solid.size),
        "profile": solid.profile.tolist(),
        "times": solid.track.times.tolist(),
        "poses": solid.track.poses.tolist(),
        "lost": solid.lost,
        "link": solid.link,
        "held": solid.held,
    }


def _solid(entry: dict[str, object]) -> Solid:
    held = entry["held"]
    return Solid(
        name=str(entry["name"]),
        kind=str(entry["kind"]),
        size=tuple(entry["size"]),  # type: ignore[arg-type]
        profile=np.array(entry["profile"], dtype=np.float64).reshape(-1, 2),
        track=Track(times=np.array(entry["times"], np.float64), poses=np.array(entry["poses"], np.float64)),
        lost=float(entry["lost"]),  # type: ignore[arg-type]
        link=entry["link"],  # type: ignore[arg-type]
        held=None if held is None else (held[0], held[1]),  # type: ignore[index]
    )
