"""Shorter paths: straight edges between points of a path that are proved free. W waypoints, J joints."""

import numpy as np

from splatctrl_cli.config import PlannerConfig
from splatctrl_cli.control.advancement import check_edges
from splatctrl_cli.control.clearance import Clearance
from splatctrl_cli.records import Float64

WORTH = 1e-3  # [rad] that a shortcut has to save


def shortened(
    clearance: Clearance, waypoints: Float64, config: PlannerConfig, random: np.random.Generator
) -> tuple[Float64, int, int]:
    """A path (W', J) of proved edges with the same ends and no longer; how many edges and postures were asked.

    First the shortest way over the waypoints, then rounds of shortcuts between random points of the path, of which
    the one that saves most is taken, and the shortest way again.
    """
    path, num_edges, num_checks = _over_waypoints(clearance, waypoints, config)
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
            path = _cut(path, cuts[int(np.argmax(check.is_free))])  # they are sorted by what they save
    return path, num_edges, num_checks


def _over_waypoints(clearance: Clearance, path: Float64, config: PlannerConfig) -> tuple[Float64, int, int]:
    """The shortest way from the first to the last waypoint over edges between waypoints, old ones and proved ones."""
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
    kept = [W - 1]
    while kept[-1] > 0:
        kept.append(int(before[kept[-1]]))
    return path[kept[::-1]], len(a), num_checks


def _random_cuts(path: Float64, num: int, random: np.random.Generator) -> Float64:
    """(K, 2) places along the path, in waypoints from its start, on different edges; the most saving first."""
    places = np.sort(_places(path, random.random((num, 2))), axis=1)
    places = places[np.floor(places[:, 0]) < np.floor(places[:, 1])]
    along = _lengths(path)
    way = np.interp(places, np.arange(len(path)), along)
    saved = way[:, 1] - way[:, 0] - np.linalg.norm(_points(path, places[:, 1]) - _points(path, places[:, 0]), axis=1)
    order = np.argsort(-saved, kind="stable")
    return np.asarray(places[order[saved[order] > WORTH]])


def _cut(path: Float64, cut: Float64) -> Float64:
    """The path with a straight edge between two places."""
    first, last = int(np.floor(cut[0])), int(np.ceil(cut[1]))
    ends = _points(path, cut)
    rows = np.concatenate([path[: first + 1], ends, path[last:]])
    is_new = np.r_[True, np.linalg.norm(np.diff(rows, axis=0), axis=1) > 1e-12]
    cut_path = rows[is_new]
    cut_path[-1] = path[-1]
    return cut_path


def _lengths(path: Float64) -> Float64:
    """(W,) joint length from the start to each waypoint."""
    return np.asarray(np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def _places(path: Float64, share: Float64) -> Float64:
    """Shares of the length as places in waypoints."""
    along = _lengths(path)
    return np.asarray(np.interp(share * along[-1], along, np.arange(len(path))))


def _points(path: Float64, places: Float64) -> Float64:
    """(K, J) the path at places (K,) in waypoints."""
    before = np.minimum(places.astype(np.int64), len(path) - 2)
    return np.asarray(path[before] + (places - before)[:, None] * (path[before + 1] - path[before]))
