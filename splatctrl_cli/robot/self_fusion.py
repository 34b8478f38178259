"""Self-models learned from depth fused in each link's frame over clearly different configurations.

Fusion of projective signed distances (Curless and Levoy, A volumetric method for building complex models from range
images, 1996). L links, V views, K configurations of a link, N cells, F triangles.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from splatctrl_cli.config.fixed import MASK_SIGMAS
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import back_project, invert_transform, project, strided_lens, transform_points
from splatctrl_cli.kernels import Int16
from splatctrl_cli.records import Bool, Box, Float32, Float64, Index, Intrinsics, RgbdFrame, spread
from splatctrl_cli.robot.self_intervals import (
    LEAST_CELLS,
    NUM_CONFIGURATIONS,
    TOUCHING,
    TRUNCATION,
    VOXEL,
    Fused,
    choose_intervals,
    find_intervals,
    spread_cells,
)
from splatctrl_cli.robot.self_model import LearnedLink, SelfModel, surface_digest
from splatctrl_cli.robot.surface import RobotSurface

REACH = 0.06  # [m] outside a link's visual surface: search distance for its parts
MOST_REACH = 0.24  # [m]: limit of that distance, which grows while parts reach it
STEP = 0.02  # [m] that a corner of a link's box moves between clearly different configurations
FINE = 0.5  # of STEP, for a link that moves too little; its parts must leave their place by `AWAY`
SAME = 0.5  # of the step, within which views of one moment share a configuration
PATH_SHARE = 0.5  # of a link's path between two moments, which separates them even if the link returned
AWAY = 0.04  # [m] from a cell's old place, beyond which a surface there is another object
MOST_ASKED = 8  # configurations with places to check in the others
MOST_LOST = 0.5  # of a piece's cells that may belong elsewhere
MOST_SETS = 40  # frame sets
WIDE = 320  # pixels across a thinned image
MEDIAN_SIGMA = 1.4826  # standard deviation of a normal distribution over its median absolute value
FAR_OFF = 0.03  # [m] from the rendered robot, beyond which a pixel shows another surface
UNEXPLAINED, EXPLAINED = -1, -2
BLOCK = 3  # cells along an edge


def choose_moments(surface: RobotSurface, T_world_link: Float64, most: int = MOST_SETS) -> list[int]:
    """Choose up to `most` of M moments, in order, with the links farthest apart.

    Farthest-point sampling uses the distance between postures, plus `PATH_SHARE` of the path between them.
    T_world_link: (M, L, 4, 4).
    """
    corners = _boxes(surface)[:, np.array(list(np.ndindex(2, 2, 2))), np.arange(3)]
    placed = _move(T_world_link, corners).reshape(len(T_world_link), -1, 3)
    steps = np.linalg.norm(np.diff(placed, axis=0), axis=2).max(axis=1)
    path = PATH_SHARE * np.append(0.0, np.cumsum(steps))
    chosen, gap = [0], np.full(len(placed), np.inf)
    while len(chosen) < most:
        apart = np.linalg.norm(placed - placed[chosen[-1]], axis=2).max(axis=1)
        gap = np.minimum(gap, apart + np.abs(path - path[chosen[-1]]))
        if gap.max() < STEP:
            break
        chosen.append(int(gap.argmax()))
    return sorted(chosen)


def learn(
    surface: RobotSurface,
    links: Sequence[str],
    frames: Sequence[RgbdFrame],
    T_world_link: Float64,
    *,
    name: str = "recording",
    reach: float = REACH,
) -> SelfModel:
    """Learn a self-model from V frames in order of time.

    T_world_link (V, L, 4, 4): of the surface's links; links: all of the robot's. reach [m]: search distance outside a
    link's visual surface, doubled up to `MOST_REACH` while parts reach it. In a run of configurations, a grid cell is
    robot if `NUM_CONFIGURATIONS` show it as surface and at most `FREE_SHARE` see through it. A configuration's views
    decide by majority. The cell must also leave its place in the world with the link, and move against each nearer
    link. A link that moves too little gets configurations half as far apart. Raises InputError if no link can be
    learned.
    """
    boxes = _boxes(surface)
    corners = boxes[:, np.array(list(np.ndindex(2, 2, 2))), np.arange(3)]
    placed = _move(T_world_link, corners)
    views = list(
        _views(
            surface,
            frames,
            T_world_link,
            np.stack([placed.min(axis=2), placed.max(axis=2)], axis=2),
            max(reach, MOST_REACH),
        )
    )
    learned: list[LearnedLink] = []
    unknown = {}
    for number, link in enumerate(surface.links):
        configurations = _configurations(placed[:, number], STEP)
        num = int(configurations.max(initial=-1)) + 1
        if is_fine := num < NUM_CONFIGURATIONS:
            configurations = _configurations(placed[:, number], FINE * STEP)
        used = [(view, int(k)) for view, k in zip(views, configurations, strict=True) if k >= 0]
        is_enough = configurations.max(initial=-1) + 1 >= NUM_CONFIGURATIONS
        new_parts = _grow_link(surface, number, boxes[number], used, reach) if is_enough else []
        if parts := [part for part in new_parts if len(part.triangles) or not is_fine]:
            learned += parts
        elif is_fine:
            unknown[link] = f"moves too little ({num} of {NUM_CONFIGURATIONS} configurations)"
        else:
            unknown[link] = f"seen in fewer than {NUM_CONFIGURATIONS} configurations"
    if not learned:
        reasons = {why: ", ".join(link for link in unknown if unknown[link] == why) for why in unknown.values()}
        raise InputError(
            f"{name}: no link can be learned: {'; '.join(f'{each}: {why}' for why, each in reasons.items())}",
            remedy=f"record the arm moving by {1e3 * NUM_CONFIGURATIONS * STEP:.0f} mm in view of the cameras",
        )
    return SelfModel(links=tuple(links), digest=surface_digest(surface), learned=tuple(learned), unknown=unknown)


@dataclass(frozen=True, kw_only=True)
class _View:
    """An image: depth (H, W) float32 [m], and its explanation.

    links (h, w) int16: the link that explains each `stride`-th pixel, `UNEXPLAINED`, or `EXPLAINED` by some link;
    points_world (M, 3) [m]: unexplained points.
    """

    stamp_ns: int
    stride: int
    lens: Intrinsics
    T_camera_world: Float64
    T_world_link: Float64
    depth: Float32
    links: Int16
    points_world: Float64


def _views(
    surface: RobotSurface, frames: Sequence[RgbdFrame], T_world_link: Float64, boxes: Float64, reach: float
) -> Iterator[_View]:
    """Yield frames, compared with the rendered robot.

    Unexplained points stay only within `reach` [m] of the links' boxes (V, L, 2, 3).
    """
    thinned, ratios = [], [np.zeros(1)]
    for frame, T in zip(frames, T_world_link, strict=True):
        stride = max(1, round(frame.depth.shape[1] / WIDE))
        lens, depth = strided_lens(frame.intrinsics, stride), np.ascontiguousarray(frame.depth[::stride, ::stride])
        shown = surface.render(T, lens, frame.T_world_camera, depth)
        is_close = (depth > 0) & (shown.depth > 0) & (np.abs(depth - shown.depth) < FAR_OFF)
        thinned.append((stride, lens, depth, shown))
        ratios.append(np.abs(depth - shown.depth)[is_close] / np.square(depth[is_close]))
    noise = MEDIAN_SIGMA * float(np.median(np.concatenate(ratios)))
    for frame, T, near, (stride, lens, depth, shown) in zip(frames, T_world_link, boxes, thinned, strict=True):
        tolerance = (VOXEL + MASK_SIGMAS * noise * np.square(depth)).astype(np.float32)
        is_link = (shown.depth > 0) & (np.abs(shown.depth - depth) <= tolerance)
        links = np.where(is_link, shown.link, np.int16(UNEXPLAINED))
        pixels = np.argwhere((depth > 0) & ~is_link)
        points = transform_points(frame.T_world_camera, back_project(lens, depth)[tuple(pixels.T)])
        is_near = np.any([_is_in(box, points, reach) for box in near], axis=0)
        v, u = pixels[is_near].T
        points = points[is_near]
        most = tolerance[v, u]
        is_own = surface.distance(T, points, within=most, enough=most) <= most
        links[v[is_own], u[is_own]] = EXPLAINED
        yield _View(
            stamp_ns=frame.stamp_ns, stride=stride, lens=frame.intrinsics, links=links, points_world=points[~is_own],
            T_camera_world=invert_transform(frame.T_world_camera), T_world_link=T, depth=frame.depth,
        )  # fmt: skip


def _grow_link(
    surface: RobotSurface, number: int, box: Float64, used: Sequence[tuple[_View, int]], reach: float
) -> list[LearnedLink]:
    parts = _learn_link(surface, number, box, used, reach)
    if 2 * reach <= MOST_REACH and any(part.outside_most > reach - VOXEL for part in parts):
        return _grow_link(surface, number, box, used, 2 * reach)
    return parts


def _learn_link(
    surface: RobotSurface, number: int, box: Float64, used: Sequence[tuple[_View, int]], reach: float
) -> list[LearnedLink]:
    points = [transform_points(invert_transform(v.T_world_link[number]), v.points_world) for v, _ in used]
    points = [part[_is_in(box, part, reach)] for part in points]
    at = np.array([k for _, k in used])
    origin, mask = _candidates(np.concatenate(points), at.repeat([len(part) for part in points]))
    cells = origin + VOXEL * np.argwhere(mask)
    gap = surface.distance_to(surface.links[number], cells, within=reach)
    is_near = (gap <= reach) & (gap > -TRUNCATION)
    mask[mask], cells, gap = is_near, cells[is_near], gap[is_near]
    in_order = [used[int(np.argmax(at == k))][0] for k in range(at.max() + 1)]
    fused = _fuse(cells, number, used, len(in_order))
    num_own = np.array([np.count_nonzero(view.links == number) for view, _ in used])
    stamps, poses = np.array([v.stamp_ns for v in in_order]), np.array([view.T_world_link for view in in_order])
    intervals = find_intervals(fused, mask, gap, stamps)
    owner = choose_intervals(fused, mask, gap, intervals)
    parts = []
    for index, interval in enumerate(intervals):
        run = slice(interval.first, interval.last + 1)
        distance, seen, free = fused.within(run)
        solid = np.where(owner == index, np.maximum(distance, VOXEL - gap), TRUNCATION)
        is_solid = solid < 0
        its = (cells[is_solid], seen[:, is_solid])
        shown = [(view, k - run.start) for view, k in used if run.start <= k < run.stop]
        stays, moves, is_other = np.zeros((3, len(cells)), bool)
        stays[is_solid], moves[is_solid] = _stays_in_world(*its, shown, poses[run, number])
        is_other[is_solid] = _is_on_other_link(surface, number, *its, gap[is_solid], poses[run], reach)
        grid = _drop_scene(spread_cells(mask, solid, TRUNCATION), spread_cells(mask, stays, 0) > 0)
        is_elsewhere = spread_cells(mask, is_other | (stays & moves), 0) > 0
        grid = _drop_scene(np.where(is_elsewhere, np.float32(TRUNCATION), grid), np.zeros_like(mask))
        is_part = (grid < 0)[mask]
        if not is_part.any() and (index or len(np.unique(at[num_own >= LEAST_CELLS])) < NUM_CONFIGURATIONS):
            continue
        place, since, heights = np.full(3, np.nan), np.nan, np.append(gap[is_part], [] if is_part.any() else [0.0])
        if is_part.any():
            place = cells[is_part][heights.argmax()]
            known = np.argmax(np.cumsum(seen[:, is_part], axis=0) >= NUM_CONFIGURATIONS, axis=0)
            since = 1e-9 * float(np.median(stamps[run][known]) - stamps.min())
        parts.append(
            LearnedLink(
                link=surface.links[number],
                origin=origin,
                voxel=VOXEL,
                distance=np.where(spread_cells(mask, (seen | free).sum(axis=0), 0) > 0, grid, np.float32(np.nan)),
                configurations=spread_cells(mask, seen.sum(axis=0), 0).astype(np.uint8),
                triangles=_triangles(grid, origin),
                outside_95=float(np.quantile(heights, 0.95)),
                outside_most=float(heights.max()),
                place=place,
                since=since,
                num_pixels=int(num_own.sum()) + sum(map(len, points)),
                num_configurations=len(in_order),
                start_ns=interval.start_ns,
                end_ns=interval.end_ns,
                first_ns=int(stamps.min()),
            )
        )
    return parts


def _fuse(cells: Float64, number: int, used: Sequence[tuple[_View, int]], num: int) -> Fused:
    total, weight = np.zeros((2, 2, num, len(cells)), np.float32)  # of surfaces, of free rays
    votes, known = np.zeros((num, len(cells)), np.int8), np.zeros((num, len(cells)), bool)
    for view, k in used:
        points = transform_points(view.T_camera_world @ view.T_world_link[number], cells)
        ahead, v, u, before = _landing(view, points, np.arange(len(cells)))
        link = view.links[v // view.stride, u // view.stride]
        is_free = before > TRUNCATION
        is_seen = (np.abs(before) <= TRUNCATION) & ((link == UNEXPLAINED) | (link == number))
        share = np.clip((before + TRUNCATION) / (TRUNCATION - VOXEL), 0.0, 1.0)
        for kind, chosen in enumerate((is_seen, is_free)):
            total[kind, k, ahead[chosen]] += (share * np.minimum(before, TRUNCATION))[chosen]
            weight[kind, k, ahead[chosen]] += share[chosen]
        votes[k, ahead] += is_seen.astype(np.int8) - is_free
        known[k, ahead] |= is_seen | is_free
    seen = votes > 0
    total, weight = (np.where(seen, each[0], each.sum(axis=0)) for each in (total, weight))
    return Fused(total=total, weight=weight, seen=seen, free=known & ~seen)


def _stays_in_world(
    cells: Float64, seen: Bool, shown: Sequence[tuple[_View, int]], poses: Float64
) -> tuple[Bool, Bool]:
    """Two masks (N,): cells that stay in the world, and cells that move by `AWAY`."""
    places, votes = _move(poses, cells), np.zeros(len(cells), np.int64)
    for view, k in shown:
        for m in spread(range(len(poses)), MOST_ASKED):
            moved = np.flatnonzero(seen[m] & (np.linalg.norm(places[m] - places[k], axis=1) >= AWAY))
            points = transform_points(view.T_camera_world, places[m, moved])
            moved, v, u, before = _landing(view, points, moved)
            is_unexplained = view.links[v // view.stride, u // view.stride] == UNEXPLAINED
            is_surface = is_unexplained & (np.abs(before) <= TRUNCATION)
            votes[moved] += is_surface.astype(np.int64) - (before > TRUNCATION)
    return votes >= 0, _span(places, seen) >= AWAY


def _landing(view: _View, points: Float64, numbers: Index) -> tuple[Index, Index, Index, Float64]:
    ahead = np.flatnonzero(points[:, 2] > TRUNCATION)
    u, v = np.floor(project(view.lens, points[ahead]) + 0.5).astype(int).T
    lands = (u >= 0) & (v >= 0) & (u < view.lens.width) & (v < view.lens.height)
    ahead, u, v = ahead[lands], u[lands], v[lands]
    known = view.depth[v, u] > 0
    ahead, u, v = ahead[known], u[known], v[known]
    return numbers[ahead], v, u, view.depth[v, u] - points[ahead, 2]


def _is_on_other_link(
    surface: RobotSurface, number: int, cells: Float64, seen: Bool, gap: Float64, poses: Float64, reach: float
) -> Bool:
    is_on_other = np.zeros(len(cells), bool)
    for other, link in enumerate(surface.links):
        places = _move(np.linalg.inv(poses[:, other]) @ poses[:, number], cells)
        if other != number and len(cells):
            is_still = _span(places, seen) < STEP
            at = places[seen.argmax(axis=0), np.arange(len(cells))]
            is_on_other |= is_still & (surface.distance_to(link, at, within=reach) < gap)
    return is_on_other


def _move(T: Float64, points: Float64) -> Float64:
    return np.asarray(np.einsum("...ij,...nj->...ni", T[..., :3, :3], points) + T[..., None, :3, 3])


def _span(values: Float64, seen: Bool) -> Float64:
    is_seen = seen[..., None]
    span = np.where(is_seen, values, -np.inf).max(axis=0) - np.where(is_seen, values, np.inf).min(axis=0)
    return np.asarray(np.linalg.norm(span, axis=-1))


def _candidates(points: Float64, configurations: Index) -> tuple[Float64, Bool]:
    edge = BLOCK * VOXEL
    block = np.floor(points / edge).astype(np.int64)
    both = np.unique(np.column_stack([block, configurations]), axis=0)
    blocks, counts = np.unique(both[:, :3], axis=0, return_counts=True)
    blocks = blocks[counts >= NUM_CONFIGURATIONS]
    if not len(blocks):
        return np.zeros(3), np.zeros((2, 2, 2), bool)
    first = blocks.min(axis=0) - 2
    mask = np.zeros(np.ptp(blocks, axis=0) + 5, bool)
    mask[tuple((blocks - first).T)] = True
    mask = ndimage.binary_dilation(mask, np.ones((3, 3, 3), bool))
    return edge * first + VOXEL / 2, mask.repeat(BLOCK, 0).repeat(BLOCK, 1).repeat(BLOCK, 2)


def _drop_scene(distance: Float32, stays: Bool) -> Float32:
    pieces, num = ndimage.label(distance < 0, TOUCHING)
    sizes = np.bincount(pieces.ravel(), minlength=num + 1)
    is_out = (sizes < LEAST_CELLS) | (np.bincount(pieces.ravel(), stays.ravel(), num + 1) > MOST_LOST * sizes)
    is_out[0] = False
    return np.where(is_out[pieces], np.float32(TRUNCATION), distance)


def _triangles(distance: Float32, origin: Float64) -> Float64:
    if not (distance < 0).any():
        return np.zeros((0, 3, 3))
    vertices, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="ascent")
    return np.asarray(origin + VOXEL * vertices[faces], np.float64)


def _boxes(surface: RobotSurface) -> Float64:
    extents = surface.extents(np.tile(np.eye(4), (len(surface.links), 1, 1)))
    return np.array([extents[link][:6] for link in surface.links]).reshape(-1, 2, 3)


def _is_in(box: Float64, points: Float64, reach: float) -> Bool:
    return Box(lower=box[0] - reach, upper=box[1] + reach).contains(points)


def _configurations(placed: Float64, step: float) -> Index:
    newest, num = np.full((8, 3), np.inf), 0
    numbers = np.full(len(placed), -1)
    for number, corners in enumerate(placed):
        gap = np.linalg.norm(corners - newest, axis=1).max()
        if num < 255 and gap >= step:
            newest, num = corners, num + 1
        if gap >= step or gap <= SAME * step:
            numbers[number] = num - 1
    return numbers
