"""The self-mask: pixels whose depth the robot's rendered surface explains (III-C)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.geometry import back_project_pixels, transform_points
from splatctrl_cli.kernels import Int16, native
from splatctrl_cli.kernels import points as kernels
from splatctrl_cli.records import Array, Bool, Float32, Float64, Index, Label, RgbdFrame, UInt8
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.render import camera_array
from splatctrl_cli.scene.seeding import camera_in_world
from splatctrl_cli.scene.surface_depth import surface_steps
from splatctrl_cli.scene.time_steps import AuditRow


class PixelKind(IntEnum):
    """Kinds of depth pixels.

    MIXED: near the robot, on no surface. DOUBTED: an object only if another frame measured it. CONTRADICTED: behind
    another frame's surface.
    """

    NOTHING = 0
    OBJECT = 1
    ROBOT = 2
    MIXED = 3
    DOUBTED = 4
    CONTRADICTED = 5


@dataclass(frozen=True, kw_only=True)
class SelfMask:
    """The self-mask of a frame.

    kinds (H, W): `PixelKind`. robot_depth (H, W) [m]: rendered, 0 = none. residuals: by link, measured minus rendered
    depth (K,) [m] inside the outline, up to `MASK_FAR_OFF`. num_inside: by link, unexplained points inside its body.
    reach [m]: an object this close before the robot counts as robot.
    """

    kinds: UInt8
    robot_depth: Float32
    residuals: Mapping[str, Float32]
    num_inside: Mapping[str, int]
    reach: float = 0.0


def self_mask(frame: RgbdFrame, robot: RobotPosture, config: OccupancyConfig) -> SelfMask:
    """Self-mask of a frame, with the robot's pose at its stamp.

    A pixel is robot if its depth z is within `self_mask_tolerance` + 2 `depth_error` z^2 of rendered depths around it
    (`self_mask_tolerance` in pixels). So is a point within this tolerance of a triangle, or inside the robot or a
    carried box. Other depth is object, unless `_judge` finds too few pixels.

    The robot is rendered up to 1 / `MASK_BORDER` of the width beyond the image.
    """
    k, border = frame.intrinsics, frame.intrinsics.width // fixed.MASK_BORDER
    lens = replace(k, cx=k.cx + border, cy=k.cy + border, width=k.width + 2 * border, height=k.height + 2 * border)
    wider = _mask_within(replace(frame, intrinsics=lens, depth=np.pad(frame.depth, border)), robot, config)
    image = slice(border, border + k.height), slice(border, border + k.width)
    kinds, depth = wider.kinds[image], wider.robot_depth[image]
    return replace(wider, kinds=np.ascontiguousarray(kinds), robot_depth=np.ascontiguousarray(depth))


def _mask_within(frame: RgbdFrame, robot: RobotPosture, config: OccupancyConfig) -> SelfMask:
    surface, T_world_link = robot.seen_at(frame.stamp_ns)
    shown = surface.render(
        T_world_link,
        frame.intrinsics,
        frame.T_world_camera,
        frame.depth,
        tolerance=config.self_mask_tolerance,
        quadratic=fixed.MASK_SIGMAS * config.depth_error,
    )
    kinds = object_mask(frame).kinds
    mask = SelfMask(kinds=kinds, robot_depth=shown.depth, residuals={}, num_inside={})
    box = find_outline(shown.depth > 0)
    if box is None:
        return mask
    reach = pixels_of(config.self_mask_tolerance, frame, shown.depth)
    edge = max(round(frame.intrinsics.width / fixed.MASK_EDGE), reach)
    wide = 2 * edge + reach + 1  # pixels from the robot, beyond which none is explained, doubted or inside
    part = grow_box(box, wide + 1, frame.depth.shape)  # one more, where a surface may extend
    depth, rendered, kinds = np.ascontiguousarray(frame.depth[part]), shown.depth[part], kinds[part]
    link, inside = shown.link[part], shown.inside[part]
    has_depth, is_robot = depth > 0, rendered > 0
    tolerance = tolerance_at(depth, config)
    nearest = nearest_within(rendered, is_robot, reach)
    farthest = farthest_within(rendered, reach)
    is_behind = depth >= nearest - tolerance
    is_explained = has_depth & is_behind
    is_explained &= depth <= farthest + tolerance
    if surface.vague:
        is_explained |= np.isin(inside, surface.vague)
    nearest_at_edge = least_within(nearest, edge - reach)  # infinite away from the outline
    nearest = least_within(nearest_at_edge, wide - edge)
    at_outline = np.isfinite(nearest) & has_depth
    is_core = cv2.erode(is_robot.view(np.uint8), _window(reach)).view(bool)
    is_sure = depth < nearest_at_edge
    is_sure |= cv2.erode(is_core.view(np.uint8), _window(edge - reach)).view(bool)
    if surface.trees:
        is_near = depth < farthest_within(farthest, wide - reach) + fixed.CONTACT_THICKNESS
        v, u = np.divmod(np.flatnonzero(at_outline & is_near & ~is_explained), depth.shape[1])
        rays = back_project_pixels(frame.intrinsics, u + part[1].start, v + part[0].start, depth[v, u])
        sure = tolerance_at(depth[v, u], config, fixed.MASK_SURE) + edge * depth[v, u] / np.float32(
            frame.intrinsics.fx
        )
        gap = surface.distance(
            T_world_link,
            transform_points(frame.T_world_camera, rays),
            within=sure,
            enough=tolerance[v, u],
            outside=~is_behind[v, u],
        )
        is_explained[v, u] = gap <= tolerance[v, u]
        is_sure[v, u] &= gap > sure
    kinds[is_explained] = PixelKind.ROBOT
    is_object = kinds == PixelKind.OBJECT
    kinds[at_outline & is_mixed(depth, is_object, tolerance, edge // 2, frame.intrinsics.fx)] = PixelKind.MIXED
    area = np.where(is_sure, np.square(depth / frame.intrinsics.fx), 0.0).astype(np.float64)
    is_object, is_edge = kinds == PixelKind.OBJECT, np.isfinite(nearest_at_edge)
    steps = surface_steps(is_object, depth, is_edge, edge, tolerance, config.depth_error)
    steps[_fixed_outline(surface, is_robot, link)] = 0.0  # else a table would run on into the foot on it
    _judge(kinds, depth, at_outline, area, steps)
    offset = depth - rendered
    is_told = is_core & has_depth & (np.abs(offset) <= fixed.MASK_FAR_OFF)
    is_told &= link < len(surface.links) - surface.num_carried
    is_told &= rendered - nearest < fixed.MASK_STEP  # stereo may show the depth of a nearer part there
    is_told &= ~is_occluded(offset, np.where(is_robot & has_depth, link, np.int16(-1)))
    is_inside = is_core & (kinds == PixelKind.OBJECT) & (inside >= 0)
    return replace(
        mask,
        reach=float(np.median(tolerance_at(rendered[is_robot], config))),
        residuals=_group_by_link(offset[is_told], link[is_told], surface.links),
        num_inside={
            name: len(indices)
            for name, indices in _group_by_link(inside[is_inside], inside[is_inside], surface.links).items()
        },
    )


def is_occluded(offset: Float32, link: Int16) -> Bool:
    """True for pixels (H, W) of an object before a link (-1: none).

    offset: measured less rendered depth [m]. An object occludes a link if over `MASK_OCCLUDED` of the link's pixels
    are over `MASK_FAR_OFF` before the link. Then pixels more than `MASK_STEP` before the link show the object.
    """
    number = link.astype(np.int64) + 1
    num_before = np.bincount(number.ravel(), (offset < -fixed.MASK_FAR_OFF).ravel())
    has_occluder = num_before > fixed.MASK_OCCLUDED * np.bincount(number.ravel())
    return np.asarray(has_occluder[number] & (offset < -fixed.MASK_STEP))


def is_mixed(depth: Float32, is_object: Bool, tolerance: Float32, reach: int, fx: float) -> Bool:
    """True for object pixels (H, W) within `reach` pixels of a nearer object and a farther surface.

    Time-of-flight cameras mix the two depths. The object is nearer than a surface tilted by `MASK_STEEP` explains.
    """
    apart = np.maximum(np.float32(fixed.MASK_STEP), np.float32(fixed.MASK_STEEP * reach / fx) * depth)
    is_behind = depth - nearest_within(depth, is_object, reach) > apart
    return np.asarray(is_object & is_behind & (farthest_within(depth, reach) - depth > tolerance))


def _fixed_outline(surface: RobotSurface, is_robot: Bool, link: Int16) -> Bool:
    still = [number for number, name in enumerate(surface.links) if name in surface.fixed]
    shown = (is_robot & np.isin(link, still)).view(np.uint8)
    return np.asarray((shown > 0) & (cv2.erode(shown, _window(1)) == 0))


def _judge(kinds: UInt8, depth: Float32, is_near: Bool, area: Float64, steps: Float32) -> None:
    """Mark object pixels near the robot that are too few to believe, in place.

    A piece joins neighbours whose depths differ by less than both `steps` [m]. It is an object if it extends away
    from the robot. Otherwise its unexplained `area` [m^2] decides: mixed below `MASK_SPECK`, doubted below
    `MASK_ALONE`.
    """
    is_object, shown = kinds == PixelKind.OBJECT, np.empty(depth.shape)
    doubtful = is_object & is_near
    native.piece_areas(depth, steps, area, is_object.view(np.uint8), doubtful.view(np.uint8), shown)
    kinds[shown < fixed.MASK_ALONE] = PixelKind.DOUBTED
    kinds[shown < fixed.MASK_SPECK] = PixelKind.MIXED


def settle_pieces(
    frame: RgbdFrame, mask: SelfMask, others: Sequence[tuple[RgbdFrame, SelfMask]], config: OccupancyConfig
) -> SelfMask:
    """Mask whose doubted pieces become object or mixed.

    A piece joins neighbours within `MASK_STEP` in depth. It is an object if one of `others` measured half of it, or
    without `others`. others: other cameras' frames, and settled frames of the last step.
    """
    box = find_outline(mask.kinds == PixelKind.DOUBTED)
    if box is None:
        return mask
    depth, doubted = np.ascontiguousarray(frame.depth[box]), (mask.kinds[box] == PixelKind.DOUBTED).view(np.uint8)
    v, u = np.nonzero(doubted)
    rays = back_project_pixels(frame.intrinsics, u + box[1].start, v + box[0].start, depth[v, u])
    points = transform_points(frame.T_world_camera, rays)
    is_object, steps = np.full(len(v), not others), np.full_like(depth, fixed.MASK_STEP)
    votes, balance = np.zeros(depth.shape), np.empty(depth.shape)
    for other, its in others:
        pixel, z = pixels_at(other, points)
        measured = np.where(pixel >= 0, other.depth.ravel()[pixel], np.float32(0.0))
        agrees = np.isin(its.kinds.ravel()[pixel], (PixelKind.OBJECT, PixelKind.DOUBTED)) & (measured > 0)
        agrees &= np.abs(z - measured) <= tolerance_at(measured, config)
        votes[v, u] = np.where(agrees, 1.0, -1.0)
        native.piece_areas(depth, steps, votes, doubted, doubted, balance)
        is_object |= balance[v, u] >= 0
    kinds = mask.kinds.copy()
    kinds[box][v, u] = np.where(is_object, np.uint8(PixelKind.OBJECT), np.uint8(PixelKind.MIXED))
    return replace(mask, kinds=kinds)


def outvote_objects(seen: Sequence[tuple[RgbdFrame, SelfMask]], origin: Float64, voxel: float) -> list[SelfMask]:
    """Masks of one time step without object pixels that robot pixels outvote.

    Frames vote in voxels of a grid with first centre `origin` (3,) [m]. Object pixels fewer than `VOTE_SHARE` times a
    voxel's robot pixels become mixed.
    """
    outvoted, masks = [], [replace(mask, kinds=mask.kinds.copy()) for _, mask in seen]
    for frame, mask in seen:
        reach = pixels_of(voxel, frame, mask.robot_depth)
        outvoted.append(cv2.dilate((mask.kinds == PixelKind.ROBOT).view(np.uint8), _window(reach)))
    native.outvote(
        [camera_in_world(frame) for frame, _ in seen], [np.ascontiguousarray(frame.depth) for frame, _ in seen],
        outvoted, [mask.kinds for mask in masks], origin, voxel, fixed.VOTE_SHARE,
        PixelKind.ROBOT, PixelKind.OBJECT, PixelKind.MIXED,
    )  # fmt: skip
    return masks


def pixels_at(frame: RgbdFrame, points: Float32 | Float64) -> tuple[Index, Float32]:
    """Flat pixel indices (N,), -1 outside, and depths (N,) [m] of points (N, 3) [m], world."""
    return kernels.pixels_at(points, camera_array(frame.intrinsics, frame.T_world_camera))


def _group_by_link(values: Array, links: Int16, names: Sequence[str]) -> dict[str, Array]:
    order = np.argsort(links, kind="stable")
    ends = np.searchsorted(links[order], np.arange(len(names) + 1))
    parts = {name: values[order[first:end]] for name, first, end in zip(names, ends, ends[1:], strict=False)}
    return {name: part for name, part in parts.items() if len(part)}


def find_outline(pixels: Bool) -> tuple[slice, slice] | None:
    """Rows and columns of the box around a mask's pixels (H, W); None without pixels."""
    left, top, width, height = cv2.boundingRect(pixels.view(np.uint8))
    return (slice(top, top + height), slice(left, left + width)) if width else None


def grow_box(box: tuple[slice, slice], pixels: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Box with `pixels` more on each side, limited to an image."""
    rows, columns = (
        slice(max(part.start - pixels, 0), min(part.stop + pixels, size))
        for part, size in zip(box, shape, strict=True)
    )
    return rows, columns


def object_mask(frame: RgbdFrame) -> SelfMask:
    """Mask without a known robot: all depth is object."""
    return SelfMask(
        kinds=(frame.depth > 0).view(np.uint8),
        robot_depth=_nothing_rendered(frame.depth.shape),
        residuals={},
        num_inside={},
    )


@lru_cache
def _nothing_rendered(shape: tuple[int, int]) -> Float32:
    """One image for all masks without a robot."""
    image = np.zeros(shape, np.float32)
    image.flags.writeable = False
    return image


def label_pixels(mask: SelfMask, label: Label) -> Bool:
    """Pixels (H, W) of the robot, or of objects."""
    return np.asarray(mask.kinds == (PixelKind.ROBOT if label == Label.ROBOT else PixelKind.OBJECT))


def drop_pixels(frame: RgbdFrame, mask: SelfMask, kind: PixelKind) -> RgbdFrame:
    """Frame with depth 0 in pixels of a kind."""
    is_of_it = mask.kinds == kind
    return replace(frame, depth=np.where(is_of_it, np.float32(0.0), frame.depth)) if is_of_it.any() else frame


def tolerance_at(depth: Float32, config: OccupancyConfig, sigmas: float = fixed.MASK_SIGMAS) -> Float32:
    """Largest allowed difference [m] of the robot's measured and rendered depth."""
    return np.asarray(config.self_mask_tolerance + sigmas * config.depth_error * depth * depth, np.float32)


def audit_masks(masks: Sequence[SelfMask]) -> dict[str, Any]:
    """`self_mask` and `inside_robot` of `AuditRow`, for each link in a mask.

    sign: 1 if the robot is measured behind its rendered surface, -1 before it; reach: the least `SelfMask.reach`.
    """
    rows, inside = {}, {}
    for link in dict.fromkeys(link for mask in masks for link in [*mask.residuals, *mask.num_inside]):
        seen = [mask for mask in masks if link in mask.residuals]
        if seen:
            offsets = np.concatenate([mask.residuals[link] for mask in seen])
            median = float(np.median(offsets))
            rows[link] = {
                "median_mm": round(1e3 * median, 2),
                "sign": int(np.sign(median)),
                "num_pixels": len(offsets),
                "reach_mm": round(1e3 * min(mask.reach for mask in seen), 2),
            }
        num_inside = sum(mask.num_inside.get(link, 0) for mask in masks)
        if num_inside:
            inside[link] = num_inside
    return {"self_mask": rows, "inside_robot": inside}


def self_mask_metrics(rows: Sequence[AuditRow], holding: Collection[str] = ()) -> dict[str, Any]:
    """Part of the self-mask in ``run.json``, over all time steps.

    `self_mask`: by link, median residual and reach [mm], and pixels. `self_mask_residual_mm`: largest absolute
    residual of judged links, or None. `inside_robot_points`: with their first step and link. Links with at least
    `MASK_PIXELS` are judged; links in `holding` (a learned part) only if no others are.
    """
    links = dict.fromkeys(link for row in rows for link in row.self_mask)
    pixels = {link: sum(row.self_mask[link]["num_pixels"] for row in rows if link in row.self_mask) for link in links}
    seen = {link for link in links if pixels[link] >= fixed.MASK_PIXELS}
    judged = seen.difference(holding) or seen
    by_link = {}
    for link in links:
        of_link = [row.self_mask[link] for row in rows if link in row.self_mask]
        medians, counts = [r["median_mm"] for r in of_link], [r["num_pixels"] for r in of_link]
        order = np.argsort(medians)
        middle = np.searchsorted(np.cumsum(np.array(counts)[order]), 0.5 * sum(counts))
        median = float(medians[order[middle]])
        by_link[link] = {
            "median_mm": median,
            "sign": int(np.sign(median)),
            "num_pixels": int(pixels[link]),
            "reach_mm": float(np.median([r.get("reach_mm", 0.0) for r in of_link])),
            "is_judged": link in judged,
        }
    enough = [row["median_mm"] for row in by_link.values() if row["is_judged"]]
    first = next(((row.stamp_ns, link) for row in rows for link in row.inside_robot), (None, None))
    return {
        "self_mask": by_link,
        "self_mask_residual_mm": max(map(abs, enough), default=None),
        "inside_robot_points": sum(sum(row.inside_robot.values()) for row in rows),
        "inside_robot_first_ns": first[0],
        "inside_robot_first_link": first[1],
    }


def nearest_within(depth: Float32, chosen: Bool, reach: int) -> Float32:
    """Least depth (H, W) of chosen pixels within `reach` pixels, else inf."""
    depths = np.full(depth.shape, np.inf, np.float32)
    cv2.copyTo(depth, chosen.view(np.uint8), depths)
    return least_within(depths, reach)


def least_within(image: Float32, reach: int) -> Float32:
    """Least value (H, W) within `reach` pixels."""
    return np.asarray(cv2.erode(image, _window(reach), borderType=cv2.BORDER_REPLICATE), np.float32)


def farthest_within(depth: Float32, reach: int) -> Float32:
    """Greatest depth (H, W) within `reach` pixels, else 0."""
    return np.asarray(cv2.dilate(depth, _window(reach)), np.float32)


def _window(reach: int) -> UInt8:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def pixels_of(length: float, frame: RgbdFrame, rendered: Float32) -> int:
    """Pixels that a length [m] spans at the robot's median depth, at least 1."""
    some = rendered[::4, ::4]
    depths = some[some > 0] if some.any() else rendered[rendered > 0]
    if not len(depths):
        return 1
    return max(1, int(np.ceil(length * frame.intrinsics.fx / float(np.median(depths)))))
