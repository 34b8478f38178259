"""BiRRT: trees from start and goals grow towards samples and each other.

RRT-Connect (Kuffner and LaValle, ICRA 2000) on batches of K samples and edges. Conservative advancement proves every
edge. J joints, G goals, W waypoints.
"""

import time
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from splatctrl_cli.config import PlannerConfig, fixed
from splatctrl_cli.control.preconditions import checked_posture
from splatctrl_cli.errors import NotEvaluableError, refuse_if
from splatctrl_cli.planner.configuration_clearance import Clearance, check_edges
from splatctrl_cli.records import Float64, Index


class PlanOutcome(StrEnum):
    """End of a search."""

    SOLVED = "solved"
    OUT_OF_ITERATIONS = "out-of-iterations"
    OUT_OF_TIME = "out-of-time"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A search's result: waypoints (W, J) [rad] to goal number `goal`, none unless solved.

    raw_path (V, J): path before shortening; num_checks: postures checked; search_time, shortcut_time [s]: wall clock.
    """

    outcome: PlanOutcome
    waypoints: Float64
    raw_path: Float64
    goal: int
    num_iterations: int
    num_edges: int
    num_checks: int
    search_time: float
    shortcut_time: float

    @property
    def is_solved(self) -> bool:
        return self.outcome is PlanOutcome.SOLVED


class _Tree:
    """Nodes q (size, J) and parent indices, -1 for a root."""

    def __init__(self, roots: Float64) -> None:
        self.q, self.squares, self.size = np.empty((256, roots.shape[1])), np.empty(256), 0
        self.parent: Index = np.empty(256, dtype=np.int64)
        self.add(roots, np.full(len(roots), -1))

    def add(self, q: Float64, parent: Index) -> Index:
        while self.size + len(q) > len(self.q):
            self.q, self.squares = np.concatenate([self.q, self.q]), np.concatenate([self.squares, self.squares])
            self.parent = np.concatenate([self.parent, self.parent])
        new = np.arange(self.size, self.size + len(q))
        self.q[new], self.parent[new] = q, parent
        self.squares[new] = np.einsum("kj,kj->k", q, q)
        self.size += len(q)
        return new

    def nearest(self, q: Float64) -> Index:
        return np.asarray(np.argmin(self.squares[: self.size] - 2.0 * (q @ self.q[: self.size].T), axis=1))

    def branch(self, node: int) -> tuple[Float64, int]:
        rows = [node]
        while self.parent[rows[-1]] >= 0:
            rows.append(int(self.parent[rows[-1]]))
        return self.q[rows[::-1]], rows[-1]


@dataclass
class _Search:
    clearance: Clearance
    config: PlannerConfig
    trees: tuple[_Tree, _Tree]
    random: np.random.Generator
    start_time: float
    num_edges: int = 0
    num_checks: int = 0
    num_iterations: int = 0

    def free_shares(self, start: Float64, end: Float64, *, only_whole: bool) -> Float64:
        """`check_edges` (E,), counted."""
        config = self.config
        check = check_edges(
            self.clearance,
            start,
            end,
            contact=config.contact,
            only_whole=only_whole,
            give_up=0.0 if only_whole else config.shortest,
        )
        self.num_edges += len(start)
        self.num_checks += check.num_checks
        return check.free_share

    def grown(self, tree: _Tree, targets: Float64) -> Index:
        """Grow `tree` towards targets (K, J) by at most `reach`, where the edge is free."""
        near = tree.nearest(targets)
        way = targets - tree.q[near]
        way *= np.minimum(1.0, self.config.reach / np.maximum(np.linalg.norm(way, axis=1), 1e-12))[:, None]
        is_free = self.free_shares(tree.q[near], tree.q[near] + way, only_whole=True) >= 1.0
        return tree.add(tree.q[near[is_free]] + way[is_free], near[is_free])

    def met(self, tree: _Tree, other: _Tree, new: Index) -> tuple[int, int] | None:
        """Grow `other` towards `tree`'s new nodes; return the pair that meets, or None."""
        near = other.nearest(tree.q[new])
        way = tree.q[new] - other.q[near]
        share = self.free_shares(other.q[near], tree.q[new], only_whole=False)
        length = np.linalg.norm(way, axis=1)
        if np.any(share >= 1.0):
            nth = int(np.argmin(np.where(share >= 1.0, length, np.inf)))
            return int(new[nth]), int(near[nth])
        is_long = share * length > self.config.shortest
        other.add(other.q[near[is_long]] + (share[:, None] * way)[is_long], near[is_long])
        return None

    def run(self) -> tuple[PlanOutcome, Float64, int]:
        first, second = self.trees
        model = self.clearance.model
        direct = self.free_shares(
            np.repeat(first.q[:1], second.size, axis=0), second.q[: second.size], only_whole=True
        )
        if np.any(direct >= 1.0):
            return PlanOutcome.SOLVED, *self._join(0, int(np.argmax(direct)))
        while self.num_iterations < self.config.max_iterations:
            if time.perf_counter() - self.start_time > self.config.max_time:
                return PlanOutcome.OUT_OF_TIME, np.empty((0, first.q.shape[1])), -1
            self.num_iterations += 1
            tree, other = (first, second) if first.size <= second.size else (second, first)
            new = self.grown(
                tree, self.random.uniform(model.lower, model.upper, (self.config.batch, len(model.lower)))
            )
            if len(new) and (meeting := self.met(tree, other, new)) is not None:
                return PlanOutcome.SOLVED, *self._join(*(meeting if tree is first else meeting[::-1]))
        return PlanOutcome.OUT_OF_ITERATIONS, np.empty((0, first.q.shape[1])), -1

    def _join(self, in_first: int, in_second: int) -> tuple[Float64, int]:
        out, back = self.trees[0].branch(in_first)[0], self.trees[1].branch(in_second)
        return np.concatenate([out, back[0][::-1]]), back[1]


def plan(clearance: Clearance, start: Float64, goals: Float64, config: PlannerConfig, *, seed: int = 0) -> Plan:
    """Plan a path from start (J,) to one of goals (G, J) or (J,) [rad].

    The same seed gives the same path. Raises InputError for a start or goal outside the limits, NotEvaluableError for
    one in collision.
    """
    began = time.perf_counter()
    roots = check_postures(clearance, start, goals, config)
    search = _Search(clearance, config, (_Tree(roots[:1]), _Tree(roots[1:])), np.random.default_rng(seed), began)
    outcome, path, goal = search.run()
    searched = time.perf_counter()
    waypoints = path
    if outcome is PlanOutcome.SOLVED:
        waypoints, num_edges, num_checks = shorten_path(clearance, path, config, search.random)
        search.num_edges += num_edges
        search.num_checks += num_checks
    return Plan(
        outcome=outcome,
        waypoints=waypoints,
        raw_path=path,
        goal=goal,
        num_iterations=search.num_iterations,
        num_edges=search.num_edges,
        num_checks=search.num_checks,
        search_time=searched - began,
        shortcut_time=time.perf_counter() - searched,
    )


def check_postures(clearance: Clearance, start: Float64, goals: Float64, config: PlannerConfig) -> Float64:
    """Start and goals (1 + G, J) within limits and free.

    Raises InputError outside the limits, NotEvaluableError in collision.
    """
    model = clearance.model
    rows = [checked_posture(model, start, what="start")]
    several = np.atleast_2d(np.asarray(goals, dtype=np.float64))
    names = ["start", *(["goal"] if len(several) == 1 else [f"goal {g}" for g in range(len(several))])]
    rows += [checked_posture(model, goal, what=name) for name, goal in zip(names[1:], several, strict=True)]
    for name, q in zip(names, rows, strict=True):
        outside = np.maximum(q - model.upper, model.lower - q)
        joint = int(np.argmax(outside))
        refuse_if(
            outside[joint] > config.limit_tolerance,
            f"{name}: joint {model.joint_names[joint]}: expected within [{model.lower[joint]:.4f}, "
            f"{model.upper[joint]:.4f}] rad, got {q[joint]:.4f}",
            remedy="give a posture within the limits, or check that the URDF is of this robot",
        )
        row, distance = clearance.worst(q)
        refuse_if(
            distance < config.contact,
            f"{name}: expected a posture {config.contact:g} m clear of its margin, got {row} at {distance:.4f} m",
            remedy="give another posture or a smaller margin, or check the scene and --base",
            error=NotEvaluableError,
        )
    return np.array(rows)


def shorten_path(
    clearance: Clearance, waypoints: Float64, config: PlannerConfig, random: np.random.Generator
) -> tuple[Float64, int, int]:
    """Shortened path (W', J) of proved edges, and the numbers of edges and checks.

    It starts with the shortest way over waypoints. Each round then takes the free random shortcut that saves most.
    """
    path, num_edges, num_checks = _skip_waypoints(clearance, waypoints, config)
    for _ in range(config.shortcut_rounds):
        if len(path) <= 2:
            break
        cuts = _random_cuts(path, config.shortcut_batch, random)
        if not len(cuts):
            continue
        start, end = _points(path, cuts[:, 0]), _points(path, cuts[:, 1])
        check = check_edges(clearance, start, end, contact=config.contact)
        num_edges, num_checks = num_edges + len(cuts), num_checks + check.num_checks
        if np.any(check.is_free):
            path = _cut(path, cuts[int(np.argmax(check.is_free))])  # sorted by saved length
    return path, num_edges, num_checks


def _skip_waypoints(clearance: Clearance, path: Float64, config: PlannerConfig) -> tuple[Float64, int, int]:
    W = len(path)
    a, b = np.triu_indices(W, k=2)
    length = np.linalg.norm(path[:, None] - path[None], axis=2)
    usable = np.eye(W, k=1, dtype=bool)
    num_checks = 0
    if len(a):
        check = check_edges(clearance, path[a], path[b], contact=config.contact)
        usable[a, b], num_checks = check.is_free, check.num_checks
    best, before = np.full(W, np.inf), np.zeros(W, dtype=np.int64)
    best[0] = 0.0
    for w in range(1, W):
        through = np.where(usable[:w, w], best[:w] + length[:w, w], np.inf)
        before[w] = int(np.argmin(through))
        best[w] = through[before[w]]
    indices = [W - 1]
    while indices[-1] > 0:
        indices.append(int(before[indices[-1]]))
    return path[indices[::-1]], len(a), num_checks


def _random_cuts(path: Float64, num: int, random: np.random.Generator) -> Float64:
    along, numbers = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))], np.arange(len(path))
    places = np.sort(np.interp(random.random((num, 2)) * along[-1], along, numbers), axis=1)
    places = places[np.floor(places[:, 0]) < np.floor(places[:, 1])]
    way = np.interp(places, numbers, along)
    saved = way[:, 1] - way[:, 0] - np.linalg.norm(_points(path, places[:, 1]) - _points(path, places[:, 0]), axis=1)
    order = np.argsort(-saved, kind="stable")
    return np.asarray(places[order[saved[order] > fixed.SHORTCUT_WORTH]])


def _cut(path: Float64, cut: Float64) -> Float64:
    first, last = int(np.floor(cut[0])), int(np.ceil(cut[1]))
    rows = np.concatenate([path[: first + 1], _points(path, cut), path[last:]])
    cut_path = rows[np.r_[True, np.linalg.norm(np.diff(rows, axis=0), axis=1) > 1e-12]]
    cut_path[-1] = path[-1]
    return cut_path


def _points(path: Float64, places: Float64) -> Float64:
    before = np.minimum(places.astype(np.int64), len(path) - 2)
    return np.asarray(path[before] + (places - before)[:, None] * (path[before + 1] - path[before]))
