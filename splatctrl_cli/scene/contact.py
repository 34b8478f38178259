"""Objects near the robot, where views are poorest and distances matter most."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatctrl_cli.config import OccupancyConfig, SceneConfig, fixed
from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Bool, Float32, Index, Label, RgbdFrame, SplatSet
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.labels import Seen, shown_kinds
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.seeding import Each, gap_seeds, world_points
from splatctrl_cli.scene.self_mask import (
    PixelKind,
    SelfMask,
    farthest_within,
    find_outline,
    grow_box,
    nearest_within,
    pixels_at,
    pixels_of,
    tolerance_at,
)


def contact_pixels(frame: RgbdFrame, mask: SelfMask, robot: RobotPosture) -> Bool:
    """Pixels (H, W) of objects within `CONTACT_REACH` of moving links."""
    chosen, outline = np.zeros(mask.kinds.shape, bool), find_outline(mask.robot_depth > 0)
    if outline is None:
        return chosen
    reach = pixels_of(fixed.CONTACT_REACH, frame, mask.robot_depth)
    box = grow_box(outline, reach, chosen.shape)
    shown, depth, is_near = mask.robot_depth[box], frame.depth[box], mask.kinds[box] == PixelKind.OBJECT
    is_near &= depth > nearest_within(shown, shown > 0, reach) - fixed.CONTACT_REACH  # a quick superset
    chosen[box] = is_near & (depth < farthest_within(shown, reach) + fixed.CONTACT_REACH + fixed.CONTACT_THICKNESS)
    chosen[chosen] = robot.is_within(world_points(frame, chosen), fixed.CONTACT_REACH, to_moving=True)
    return chosen


def count_carried(
    declared: Declarations, frame: RgbdFrame, mask: SelfMask, robot: RobotPosture, bare: RobotSurface, time_s: float
) -> None:
    """Count declared boxes that explain robot pixels, where the `bare` surface does not.

    bare: without what the robot carries; time_s: since the first joint state.
    """
    surface, T_world_link = robot.seen_at(frame.stamp_ns)
    poses = dict(zip(surface.links, T_world_link, strict=True))
    points = world_points(frame, mask.kinds == PixelKind.ROBOT)
    is_own = bare.distance(bare.poses(poses), points) < fixed.CONTACT_REACH / 2
    for link in dict.fromkeys(link for link, _ in declared.carried_at(time_s)):
        declared.is_carried(link, transform_points(invert_transform(poses[link]), points[~is_own]), time_s)


def contact_seeds(
    seen: Seen,
    mappable: Sequence[Bool],
    robot: RobotPosture,
    objects: SplatSet,
    config: SceneConfig,
    *,
    num_threads: int = 1,
    each: Each = map,
) -> Seeds:
    """Seeds on objects near the robot without a splat's centre within `contact_radius`.

    Their radius is half of it: larger splats stand out of a plane. The surface is assumed to extend that far into
    the hidden contact. mappable: pixels (H, W) of each frame.
    """
    radius = config.contact_radius
    beside = each(lambda one, pixels: contact_pixels(one[0], one[1], robot) & pixels, seen, mappable)
    seeds = gap_seeds(
        [(frame, pixels) for (frame, _), pixels in zip(seen, beside, strict=True)],
        np.zeros((0, 3), np.float32),
        radius,
        replace(objects, radii=np.full(len(objects), radius, np.float32)),
        replace(config, max_gap=0.0, max_radius=radius, radius_per_edge=1.0),
        stride=1,
        num_threads=num_threads,
        each=each,
    )
    return replace(seeds, radii=0.5 * seeds.radii)


def lasts_at_fixed_links(
    robot: RobotPosture,
    frames: Sequence[RgbdFrame],
    lasting: Sequence[Bool],
    config: OccupancyConfig,
    points: Float32,
) -> Bool:
    """True for points (K, 3) [m], world, away from fixed links or on `lasting` pixels (H, W).

    Stereo gives pixels outside a link's outline the link's depth in some frames.
    """
    distance = robot.distance(points)
    is_kept = (distance > fixed.ROBOT_REACH) | (distance >= robot.distance(points, to_moving=True))
    for frame, pixels in zip(frames, lasting, strict=True):
        pixel, z = pixels_at(frame, points)
        depth = frame.depth.ravel()[pixel]
        is_kept |= (pixel >= 0) & pixels.ravel()[pixel] & (np.abs(z - depth) <= tolerance_at(depth, config))
    return np.asarray(is_kept)


def hidden_objects(
    buffer: SplatBuffer,
    robot: RobotPosture | None,
    seen: Seen,
    config: OccupancyConfig,
    reach: float = fixed.ROBOT_REACH,
) -> Index:
    """Slots (K,) of objects within `reach` [m] of the robot or base that no pixel shows.

    Fitting would pull them out of their object.
    """
    if robot is None:
        return np.zeros(0, np.intp)
    slots = np.flatnonzero(buffer.is_alive & (buffer.labels != Label.ROBOT))
    slots = slots[robot.is_within(buffer.centers[slots], reach)]
    return np.asarray(slots[shown_kinds(buffer.centers[slots], seen, config) != PixelKind.OBJECT], np.intp)
