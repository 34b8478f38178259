"""The robot's self-model: what depth shows fixed to a link over clearly different configurations.

Projective signed distances (Curless and Levoy, A volumetric method for building complex models from range images,
1996), fused per link and in the link's frame. L links, V views, K configurations of a link, N cells, F triangles.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import back_project, invert_transform, project, strided_lens, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, Index, Intrinsics, RgbdFrame
from splatctrl_cli.robot.surface import RobotSurface

VOXEL = 0.004  # [m]
TRUNCATION = 3 * VOXEL  # [m] before and behind a measured surface
REACH = 0.06  # [m] outside of a link's visual surface, in which its parts are looked for
STEP = 0.03  # [m] by which some corner of a link's box moves between clearly different configurations
SAME = 0.01  # [m] within which cameras of one moment see a link in one configuration
NUM_CONFIGURATIONS = 5  # that a cell has to be a surface in
FREE_SHARE = 0.3  # of the configurations that see a cell; where more see through it, it is no robot
TURN = 0.97  # mean length of a surface's normals in world, below which they turn by 15 degrees or more
LEAST_CELLS = 24  # of a part, 1.5 cm^3
MOST_LOST = 0.5  # of a piece, which more cells that belong elsewhere make no part
MOST_SETS = 40  # frame sets
WIDE = 320  # pixels of an image across, to which it is thinned
SIGMAS = 2.0  # of the sensor's error that the visual surface explains
MEDIAN_SIGMA = 1.4826  # standard deviation of a normal distribution by its median size
FAR_OFF = 0.03  # [m] from the rendered robot, beyond which a pixel shows something else
UNEXPLAINED, EXPLAINED = -1, -2
BLOCK = 3  # cells along an edge


@dataclass(frozen=True, kw_only=True)
class LearnedLink:
    """A link that was seen in clearly different configurations.

    origin (3,) [m], link frame: of the first cell's centre; distance (X, Y, Z) float32 [m], NaN where nothing is
    known; configurations (X, Y, Z) uint8 in which a cell was a surface; triangles (F, 3, 3) [m], link frame: closed
    surfaces of what stands outside the visual surface; place (3,) [m], link frame: where it stands out most.
    stands_out [m]: of visible surface outside the visual surface, 95 % and most. since [s] from the first frame: when
    the part could be known, NaN without one.
    """

    link: str
    origin: Float64
    distance: Float32
    configurations: NDArray[np.uint8]
    triangles: Float64
    place: Float64
    stands_out: tuple[float, float]
    num_pixels: int
    num_configurations: int
    since: float

    @property
    def area(self) -> float:
        """Of the triangles [m^2]."""
        sides = np.diff(self.triangles, axis=1)
        return float(0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum())


ARRAYS = ("origin", "distance", "configurations", "triangles", "place")
FIGURES = ("num_pixels", "num_configurations", "since")


@dataclass(frozen=True, kw_only=True)
class SelfModel:
    """links: the robot's; digest: of its visual geometry; unknown: links that could not be learned, and why."""

    links: tuple[str, ...]
    digest: str
    learned: tuple[LearnedLink, ...]
    unknown: Mapping[str, str]

    def pieces(self) -> list[tuple[str, Float64]]:
        """Links and the triangles (F, 3, 3) [m], in their frame, that belong to the robot's surface as well."""
        return [(part.link, part.triangles) for part in self.learned if len(part.triangles)]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of it by name, for a file."""
        found: dict[str, NDArray[Any]] = {
            "links": np.array(self.links),
            "digest": np.array(self.digest),
            "voxel": np.array(VOXEL),
            "learned": np.array([part.link for part in self.learned], dtype=np.str_),
            "unknown": np.array(list(self.unknown.items()), dtype=np.str_).reshape(-1, 2),
        }
        for part in self.learned:
            found |= {f"{part.link}.{name}": getattr(part, name) for name in ARRAYS}
            figures = [*part.stands_out, *(getattr(part, name) for name in FIGURES)]
            found[f"{part.link}.figures"] = np.array(figures, np.float64)
        return found

    @classmethod
    def of_arrays(cls, found: Mapping[str, Any]) -> "SelfModel":
        """What `arrays` gave. Raises KeyError, TypeError or ValueError for other arrays."""
        return cls(
            links=tuple(map(str, found["links"])),
            digest=str(found["digest"]),
            learned=tuple(_learned_link(str(link), found) for link in found["learned"]),
            unknown={str(link): str(why) for link, why in found["unknown"]},
        )

    def check_robot(self, surface: RobotSurface, links: Sequence[str], path: Path) -> None:
        """Raise InputError where the file `path` is of another robot than that of these links and visual surface."""
        difference = "its visual geometry differs"
        if other := sorted(set(self.links) ^ set(links)):
            difference = f"{', '.join(other[:4])} are not links of both"
        elif self.digest == surface_digest(surface):
            return
        raise InputError(
            f"{path}: self-model of another robot: {difference}",
            remedy="learn it again with this URDF, or give the robot that it was learned for",
        )


def _learned_link(link: str, found: Mapping[str, Any]) -> LearnedLink:
    outside, most, pixels, configurations, since = map(float, found[f"{link}.figures"])
    arrays = {name: found[f"{link}.{name}"] for name in ARRAYS}
    triangles = arrays["triangles"]
    if triangles.dtype != np.float64 or triangles.shape[1:] != (3, 3) or not np.isfinite(triangles).all():
        raise ValueError(f"triangles of {link}: expected finite (F, 3, 3), got {triangles.shape}")
    return LearnedLink(
        link=link,
        **arrays,
        stands_out=(outside, most),
        num_pixels=int(pixels),
        num_configurations=int(configurations),
        since=since,
    )


def surface_digest(surface: RobotSurface) -> str:
    """sha256 of the geometry by links, without those that spheres stand for."""
    digest = hashlib.sha256()
    for number, link in enumerate(surface.links):
        if link not in surface.by_spheres:
            digest.update(link.encode())
            is_its = surface.solid_links == number
            for array in (surface.kinds, surface.sizes, surface.T_link_solid):
                digest.update(np.round(array[is_its], 7).tobytes())
            digest.update(np.round(surface.triangles[surface.triangle_links == number], 7).tobytes())
    return digest.hexdigest()


def choose_moments(surface: RobotSurface, T_world_link: Float64, most: int = MOST_SETS) -> list[int]:
    """Numbers of at most `most` of M moments, in order, between which the links moved farthest (farthest-point
    sampling). T_world_link: (M, L, 4, 4).
    """
    placed = _placed(_boxes(surface), T_world_link).reshape(len(T_world_link), -1, 3)
    chosen, gap = [0], np.full(len(placed), np.inf)
    while len(chosen) < most:
        gap = np.minimum(gap, np.linalg.norm(placed - placed[chosen[-1]], axis=2).max(axis=1))
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
    """The self-model that V frames of a robot show, with the links of its surface at T_world_link (V, L, 4, 4).

    links: all of the robot's. reach [m]: how far outside a link's visual surface its parts are looked for. A cell of
    a link's grid is robot where it is a surface in `NUM_CONFIGURATIONS` of the link, no more than `FREE_SHARE` of
    those that see it see through it, and no plane that stays in the world explains it. Raises InputError where no
    link moves.
    """
    boxes = _boxes(surface)
    placed = _placed(boxes, T_world_link)
    configurations = [_configurations(placed[:, number]) for number in range(len(surface.links))]
    counts = [int(its.max(initial=-1)) + 1 for its in configurations]
    if max(counts, default=0) < NUM_CONFIGURATIONS:
        raise InputError(
            f"{name}: the arm does not move: {', '.join(surface.links)} cannot be learned, because what is fixed to"
            f" them stays like the scene (expected {NUM_CONFIGURATIONS} configurations {1e3 * STEP:.0f} mm apart)",
            remedy="record the arm moving in view of the cameras",
        )
    near = np.stack([placed.min(axis=2) - reach, placed.max(axis=2) + reach], axis=2)
    views = _views(surface, frames, T_world_link, near)
    learned, unknown = [], {}
    for number, link in enumerate(surface.links):
        if counts[number] < NUM_CONFIGURATIONS:
            unknown[link] = f"moves too little ({counts[number]} configurations): its parts stay like the scene"
            continue
        grown = boxes[number] + [[-reach], [reach]]
        found = _learn_link(surface, number, grown, views, configurations[number], reach)
        if found is None:
            unknown[link] = f"no camera sees it in {NUM_CONFIGURATIONS} configurations"
        else:
            learned.append(found)
    return SelfModel(links=tuple(links), digest=surface_digest(surface), learned=tuple(learned), unknown=unknown)


@dataclass(frozen=True, kw_only=True)
class _View:
    """A thinned image: depth (H, W) float32 [m]; links (H, W) int16, the link that explains a pixel, `UNEXPLAINED` or
    `EXPLAINED` by some; outside (H, W) float32 [m], how far it is measured before the rendered robot; points_world
    (M, 3) [m] of what no link explains.
    """

    stamp_ns: int
    lens: Intrinsics
    T_camera_world: Float64
    T_world_link: Float64
    depth: Float32
    links: NDArray[np.int16]
    outside: Float32
    points_world: Float64


def _views(surface: RobotSurface, frames: Sequence[RgbdFrame], T_world_link: Float64, near: Float64) -> list[_View]:
    """Frames beside the rendered robot, whose surface explains a pixel as far as the recording's noise; near (V, L,
    2, 3) [m], world: boxes in which what it does not explain is kept.
    """
    thinned = []
    for frame, T in zip(frames, T_world_link, strict=True):
        stride = max(1, round(frame.depth.shape[1] / WIDE))
        lens, depth = strided_lens(frame.intrinsics, stride), np.ascontiguousarray(frame.depth[::stride, ::stride])
        thinned.append((lens, depth, surface.render(T, lens, frame.T_world_camera, depth)))
    offsets = [np.abs(depth - shown.depth)[(depth > 0) & (shown.depth > 0)] for _, depth, shown in thinned]
    depths = [depth[(depth > 0) & (shown.depth > 0)] for _, depth, shown in thinned]
    is_close = np.concatenate(offsets) < FAR_OFF
    scaled = np.concatenate(offsets)[is_close] / np.square(np.concatenate(depths)[is_close])
    noise = MEDIAN_SIGMA * float(np.median(scaled)) if len(scaled) else 0.0
    views = []
    for frame, T, boxes, (lens, depth, shown) in zip(frames, T_world_link, near, thinned, strict=True):
        tolerance = (VOXEL + SIGMAS * noise * np.square(depth)).astype(np.float32)
        outside = shown.depth - depth
        links = np.where((shown.depth > 0) & (np.abs(outside) <= tolerance), shown.link, np.int16(UNEXPLAINED))
        v, u = np.nonzero((depth > 0) & (links == UNEXPLAINED))
        points = transform_points(frame.T_world_camera, back_project(lens, depth)[v, u])
        is_near = np.zeros(len(points), bool)
        for box in boxes:
            is_near |= _is_in(box, points)
        v, u, points = v[is_near], u[is_near], points[is_near]
        is_own = surface.distance(T, points, within=tolerance[v, u]) <= tolerance[v, u]
        links[v[is_own], u[is_own]] = EXPLAINED
        view = _View(
            stamp_ns=frame.stamp_ns, lens=lens, T_camera_world=invert_transform(frame.T_world_camera),
            T_world_link=T, depth=depth, links=links, outside=outside, points_world=points[~is_own],
        )  # fmt: skip
        views.append(view)
    return views


def _learn_link(
    surface: RobotSurface, number: int, box: Float64, views: Sequence[_View], configurations: Index, reach: float
) -> LearnedLink | None:
    """A link with its box (2, 3) by the views in which it has a configuration (V,), -1: none; None where it is seen
    in too few of them.
    """
    used = [(view, int(k)) for view, k in zip(views, configurations, strict=True) if k >= 0]
    own = [view.outside[view.links == number] for view, _ in used]
    if len({k for (_, k), values in zip(used, own, strict=True) if len(values) >= LEAST_CELLS}) < NUM_CONFIGURATIONS:
        return None
    points = []
    for view, _ in used:
        inside = transform_points(invert_transform(view.T_world_link[number]), view.points_world)
        points.append(inside[_is_in(box, inside)])
    visible = np.concatenate(points)
    origin, mask = _candidates(visible, np.repeat([k for _, k in used], [len(part) for part in points]))
    cells = origin + VOXEL * np.argwhere(mask)
    gap = _own_distance(surface, number, cells, reach)
    is_near = (gap <= reach) & (gap > -TRUNCATION)
    mask[mask], cells, gap = is_near, cells[is_near], gap[is_near]
    first = {k: view for view, k in reversed(used)}
    in_order = [first[k] for k in sorted(first)]
    measured, seen, free = _fuse(cells, number, used, len(in_order))
    counts, num_free = np.sum(seen & ~free, axis=0), np.sum(free, axis=0)
    is_robot = np.isfinite(measured) & (counts >= NUM_CONFIGURATIONS) & (num_free <= FREE_SHARE * (counts + num_free))
    solid = np.where(is_robot, np.maximum(measured, VOXEL - gap), TRUNCATION)
    chosen = np.flatnonzero(solid < 0)
    poses = np.array([view.T_world_link for view in in_order])
    normals = _normals(_spread(mask, measured, np.nan))[mask][chosen]
    is_else = _stays_in_world(cells[chosen], seen[:, chosen], normals, poses[:, number])
    is_else |= _is_on_other_link(surface, number, cells[chosen], seen[:, chosen], gap[chosen], poses)
    left_out = np.zeros(len(cells), bool)
    left_out[chosen] = is_else
    distance = _without_others(_spread(mask, solid, TRUNCATION), _spread(mask, left_out, 0) > 0)
    is_part = ndimage.binary_dilation(distance < 0)
    at_part = np.floor((visible - origin) / VOXEL + 0.5).astype(int)
    at_part = at_part[np.all((at_part >= 0) & (at_part < mask.shape), axis=1)]
    heights = _spread(mask, gap, 0.0)[tuple(at_part[is_part[tuple(at_part.T)]].T)]
    outside = np.concatenate([np.zeros(sum(map(len, own))), heights])
    place = np.full(3, np.nan)
    since = np.nan
    in_part = (distance < 0)[mask]
    if in_part.any():
        place = cells[in_part][np.argmax(gap[in_part])]
        reached = np.cumsum(seen[:, in_part], axis=0) >= NUM_CONFIGURATIONS
        stamps = np.array([view.stamp_ns for view in in_order])[reached.argmax(axis=0)]
        since = 1e-9 * float(np.median(stamps) - min(view.stamp_ns for view in views))
    return LearnedLink(
        link=surface.links[number],
        origin=origin,
        distance=np.where(_spread(mask, counts + num_free, 0) > 0, distance, np.float32(np.nan)),
        configurations=_spread(mask, counts, 0).astype(np.uint8),
        triangles=_triangles(distance, origin),
        place=place,
        stands_out=(float(np.quantile(outside, 0.95)), float(outside.max())),
        num_pixels=len(outside),
        num_configurations=len(in_order),
        since=since,
    )


def _fuse(cells: Float64, number: int, used: Sequence[tuple[_View, int]], num: int) -> tuple[Float64, Bool, Bool]:
    """Of cells (N, 3) [m], in a link's frame: their mean distance (N,) [m] before the measured surface, positive
    outside, and whether they are a surface, and free, in each configuration (K, N).
    """
    total, weight = np.zeros(len(cells)), np.full(len(cells), 1e-9)
    seen, free = np.zeros((num, len(cells)), bool), np.zeros((num, len(cells)), bool)
    for view, k in used:
        points = transform_points(view.T_camera_world @ view.T_world_link[number], cells)
        ahead = np.flatnonzero(points[:, 2] > TRUNCATION)
        u, v = np.floor(project(view.lens, points[ahead]) + 0.5).astype(int).T
        lands = (u >= 0) & (v >= 0) & (u < view.lens.width) & (v < view.lens.height)
        ahead, u, v = ahead[lands], u[lands], v[lands]
        before, link = view.depth[v, u] - points[ahead, 2], view.links[v, u]
        is_free = before > TRUNCATION
        is_seen = (np.abs(before) <= TRUNCATION) & ((link == UNEXPLAINED) | (link == number))
        is_known = (is_free | is_seen) & (view.depth[v, u] > 0)
        share = np.clip((before + TRUNCATION) / (TRUNCATION - VOXEL), 0.0, 1.0) * is_known
        total[ahead] += share * np.minimum(before, TRUNCATION)
        weight[ahead] += share
        seen[k, ahead] |= is_seen & is_known
        free[k, ahead] |= is_free & is_known
    return np.where(weight > 0.5, total / weight, np.nan), seen, free


def _stays_in_world(cells: Float64, seen: Bool, normals: Float64, poses: Float64) -> Bool:
    """Cells (N,) whose surface a plane that stays in the world explains in the configurations (K, N) that see it: its
    normal does not turn, and it does not move along it by `STEP`. normals (N, 3), link frame; T_world_link (K, 4, 4).
    """
    turned = np.einsum("kij,nj->kni", poses[:, :3, :3], normals)
    normal = np.einsum("kn,kni->ni", seen / np.maximum(seen.sum(axis=0), 1), turned)
    length = np.linalg.norm(normal, axis=1)
    along = np.einsum("kni,ni->kn", _moved(poses, cells), normal) / np.maximum(length, 1e-6)
    return np.asarray((length >= TURN) & (_span(along[..., None], seen) < STEP))


def _is_on_other_link(
    surface: RobotSurface, number: int, cells: Float64, seen: Bool, gap: Float64, poses: Float64
) -> Bool:
    """Cells (N,) that lie nearer to a link against which they do not move by `STEP`; T_world_link (K, L, 4, 4)."""
    found = np.zeros(len(cells), bool)
    for other in range(len(surface.links)):
        between = np.linalg.inv(poses[:, other]) @ poses[:, number]
        places = _moved(between, cells)
        if other != number and len(cells):
            is_still = _span(places, seen) < STEP
            at = places[seen.argmax(axis=0), np.arange(len(cells))]
            found |= is_still & (_own_distance(surface, other, at, REACH) < gap)
    return found


def _moved(T: Float64, points: Float64) -> Float64:
    """Points (N, 3) in each of K frames (K, N, 3), moved by T (K, 4, 4)."""
    return np.asarray(np.einsum("kij,nj->kni", T[:, :3, :3], points) + T[:, None, :3, 3])


def _span(values: Float64, seen: Bool) -> Float64:
    """Diagonal (N,) of the box about the values (K, N, D) that are seen (K, N)."""
    is_seen = seen[..., None]
    span = np.where(is_seen, values, -np.inf).max(axis=0) - np.where(is_seen, values, np.inf).min(axis=0)
    return np.asarray(np.linalg.norm(span, axis=-1))


def _candidates(points: Float64, configurations: Index) -> tuple[Float64, Bool]:
    """Centre (3,) [m] of the first cell and mask (X, Y, Z) of the cells around points (M, 3) [m] that are there in
    enough configurations (M,).
    """
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


def _spread(mask: Bool, values: NDArray[Any], rest: float) -> Float32:
    """Values (N,) of the cells of a mask (X, Y, Z), in a grid (X, Y, Z) with the rest."""
    grid = np.full(mask.shape, np.float32(rest))
    grid[mask] = values
    return grid


def _normals(distance: Float32) -> Float64:
    """Unit normals (X, Y, Z, 3), outwards, of a grid smoothed over its cells; NaN ones are as the nearest other."""
    nearest = ndimage.distance_transform_edt(np.isnan(distance), return_distances=False, return_indices=True)
    filled = distance[tuple(nearest)]
    slopes = [ndimage.gaussian_filter(filled, 1.5, order=order) for order in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    normals = np.stack(slopes, axis=-1).astype(np.float64)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12))


def _without_others(distance: Float32, is_else: Bool) -> Float32:
    """The grid without cells that are no part of the link, without pieces of which they are the most, and without
    pieces of fewer than `LEAST_CELLS`.
    """
    for left_out in (is_else, np.zeros_like(is_else)):
        pieces, num = ndimage.label(distance < 0)
        sizes = np.bincount(pieces.ravel(), minlength=num + 1)
        lost = np.bincount(pieces.ravel(), left_out.ravel(), num + 1)
        is_out = (sizes < LEAST_CELLS) | (lost > MOST_LOST * sizes)
        is_out[0] = False
        distance = np.where(is_out[pieces] | left_out, np.float32(TRUNCATION), distance)
    return distance


def _triangles(distance: Float32, origin: Float64) -> Float64:
    """Closed surface (F, 3, 3) [m] around the cells below 0, anticlockwise from outside."""
    if not (distance < 0).any():
        return np.zeros((0, 3, 3))
    vertices, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="ascent")
    return np.asarray(origin + VOXEL * vertices[faces], np.float64)


def _own_distance(surface: RobotSurface, number: int, points: Float64, within: float) -> Float64:
    """Signed distance (N,) [m] of points (N, 3) in a link's frame to its visual surface alone; infinite beyond
    `within` [m].
    """
    others = [link for k, link in enumerate(surface.links) if k != number]
    still = np.tile(np.eye(4), (len(surface.links), 1, 1))
    return surface.distance(still, points, without=others, within=within)


def _boxes(surface: RobotSurface) -> Float64:
    """Lower and upper corner (L, 2, 3) [m] of each link's box, in its frame."""
    extents = surface.extents(np.tile(np.eye(4), (len(surface.links), 1, 1)))
    return np.array([extents[link][:6] for link in surface.links]).reshape(-1, 2, 3)


def _is_in(box: Float64, points: Float64) -> Bool:
    """Points (N, 3) [m] in a box (2, 3)."""
    return np.asarray(np.all((points >= box[0]) & (points <= box[1]), axis=1))


def _placed(boxes: Float64, T_world_link: Float64) -> Float64:
    """Corners (V, L, 8, 3) [m], world, of the links' boxes (L, 2, 3)."""
    chosen = np.array(list(np.ndindex(2, 2, 2)))
    corners = boxes[:, chosen, np.arange(3)]
    turned = np.einsum("vlij,lcj->vlci", T_world_link[..., :3, :3], corners)
    return np.asarray(turned + T_world_link[..., None, :3, 3])


def _configurations(placed: Float64) -> Index:
    """Which of a link's clearly different configurations each view has (V,), -1: none; corners (V, 8, 3) [m]."""
    keys: list[Float64] = []
    found = np.full(len(placed), -1)
    for number, corners in enumerate(placed):
        gaps = np.array([np.linalg.norm(corners - key, axis=1).max() for key in keys])
        if len(keys) < 255 and gaps.min(initial=np.inf) >= STEP:
            keys.append(corners)
            found[number] = len(keys) - 1
        elif keys and gaps.min() <= SAME:
            found[number] = int(gaps.argmin())
    return found
