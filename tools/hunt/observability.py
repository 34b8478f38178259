"""Rules for whether a recording contains evidence of a fault, applied before the tool reads it.

1. Depth and poses of a camera: its images show the arm, or another camera that is not wrong in the same way sees the
   same surface.
2. Clocks: an image of a wrong camera shows the arm while it moves.
3. The robot's model: too few or too small spheres always (the URDF has the surface); what else is wrong with the
   model or the joints, and a part that it has not, only where images show the arm.
4. The target: what stands there from the beginning has returned depth (of one that is measured behind its place, on
   rays through the table) in two frame sets (or the only one) before
   the arm came nearest; or it is wide (4 cm), returns none, and is a hole in two frame sets, with depth of other
   things all around it; or no image shows it, and it is so wide that it stands in unknown space. Disclaimed is what
   returns no depth before something else that returns none, or beside the arm; and what is narrower than half a
   pixel. What comes later has returned depth in a frame set taken while the arm was inside the margin; or it stood
   there for `STALE_S` without returning any, or no camera returned any depth for as long: then the map is too old.
   In closed loop, where nobody knows beforehand when the arm is near, what appears or leaves has returned depth in
   two frame sets, and what moves is disclaimed: at 1 m/s it goes ten margins between two frame sets.
"""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.simulate.primitives import Primitive
from tools.hunt.families import Draft
from tools.hunt.recording import Shown
from tools.hunt.world import World, at_s

MARGIN = 0.020  # [m] control.margin's default
TOLERATED = 0.005  # [m] under the margin
STALE_S = 1.4  # [s] the default of max_map_age, and two frame sets
NUM_PIXELS = 8  # of the target in the images of one frame set
NUM_ARM_PIXELS = 30
NUM_OVERLAP = 100  # [px]
WIDE = 0.04  # [m] two voxels
WRIST_PIXEL = 0.005  # [m] of a lone camera on the hand, at 0.4 m


@dataclass(frozen=True, kw_only=True)
class Observable:
    """Whether the evidence is there, and the rule that said so."""

    holds: bool
    rule: str


def observable(
    draft: Draft, world: World, shown: Shown, *, frame_clearance: np.ndarray, least_ns: int, is_audit: bool
) -> Observable:
    """Observability by the module's rules. frame_clearance (F,) [m]: between arm and target when the images were
    taken; least_ns: time when the recorded motion was nearest.
    """
    fault = _of_fault(draft, world, shown)
    if not fault.holds:
        return fault
    is_beyond = draft.fault.is_beyond
    return _of_target(world, shown, frame_clearance, least_ns, is_audit=is_audit, is_beyond=is_beyond)


def _of_fault(draft: Draft, world: World, shown: Shown) -> Observable:
    fault = draft.fault
    wrong = {name for errors in (fault.depth_scale, fault.depth_bias, fault.pose) for name in errors}
    late = set(fault.clock)
    rows = [index for index, name in enumerate(shown.cameras) if name in wrong | late]
    if wrong and not _sees_arm(shown, rows, np.ones(len(shown.stamps), dtype=bool)):
        others = [index for index, name in enumerate(shown.cameras) if name not in wrong]
        overlap = max((int(max(shown.overlap[i, j], shown.overlap[j, i])) for i in rows for j in others), default=0)
        holds = overlap >= NUM_OVERLAP
        return Observable(holds=holds, rule="cameras overlap" if holds else "a camera alone that never sees the arm")
    begin, end = (at_s(float(second)) for second in world.motion.times[[1, 2]])
    moves = (shown.stamps > begin) & (shown.stamps < end)
    if late and not _sees_arm(shown, rows, moves):
        return Observable(holds=False, rule="no image of the arm while it moves")
    is_of_spheres = fault.spheres_kept < 1 or fault.spheres_shrunk > 0
    is_of_model = (fault.is_of_model and not is_of_spheres) or world.tool is not None or bool(world.body.parts)
    if is_of_model and not _sees_arm(shown, list(range(len(shown.cameras))), moves):
        return Observable(holds=False, rule="no image of the arm")
    return Observable(holds=True, rule="")


def _sees_arm(shown: Shown, rows: list[int], frames: np.ndarray) -> bool:
    """True if the cameras show the arm in three images of these frame sets."""
    return bool(np.count_nonzero(shown.arm[rows][:, frames] >= NUM_ARM_PIXELS) >= 3)


def _of_target(
    world: World, shown: Shown, frame_clearance: np.ndarray, least_ns: int, *, is_audit: bool, is_beyond: bool
) -> Observable:
    pixels = shown.target.sum(axis=0)
    is_before = shown.stamps <= least_ns if is_audit else np.ones(len(pixels), dtype=bool)
    seen = (pixels >= NUM_PIXELS) & is_before
    first_ns = max(target.from_ns for target in world.targets)
    num_enough = min(2, int(np.count_nonzero(is_before)))
    width = min(min(_widths(target.kind, target.size)) for target in world.targets)
    if width < 0.5 * _pixel(world):
        return Observable(holds=False, rule="narrower than half a pixel")
    if all(target.track is None for target in world.targets) and first_ns <= shown.stamps[0]:
        if np.count_nonzero(seen) >= num_enough:
            return Observable(holds=True, rule="seen before")
        is_wide = width >= WIDE
        if is_wide and np.count_nonzero(shown.target_hole.max(axis=0)[is_before] >= NUM_PIXELS) >= num_enough:
            return Observable(holds=True, rule="a hole")
        if is_beyond:
            return Observable(holds=False, rule="measured in free space")
        if shown.target_outline[:, is_before].sum() >= NUM_PIXELS:
            return Observable(holds=is_wide, rule="dark, in space never seen" if is_wide else "returns no depth")
        return Observable(holds=is_wide, rule="space never seen" if is_wide else "no depth from it")
    if not is_audit and any(target.track is not None for target in world.targets):
        return Observable(holds=False, rule="moves between two frame sets")
    if not is_audit:
        holds = np.count_nonzero(seen) >= 2
        return Observable(holds=bool(holds), rule="seen twice" if holds else "not seen twice")
    if np.any(seen & (frame_clearance < MARGIN - TOLERATED)):
        return Observable(holds=True, rule="seen inside the margin")
    recent = (shown.stamps <= least_ns) & (shown.stamps > least_ns - STALE_S * 1e9)
    if not shown.depth.sum(axis=0)[recent].any():
        return Observable(holds=True, rule="no depth for long")
    since_ns = max(_at_its_place_since(target, least_ns) for target in world.targets)
    if since_ns < least_ns - STALE_S * 1e9 and np.all(pixels[recent] < NUM_PIXELS):
        return Observable(holds=True, rule="not seen for long")
    return Observable(holds=False, rule="between two frame sets")


def _pixel(world: World) -> float:
    """How wide [m] a pixel of the nearest camera is at the target."""
    place = world.targets[0].T_world_shape[:3, 3]
    return min(
        (float(np.linalg.norm(c.T_world_camera[:3, 3] - place)) / c.intrinsics.fx for c in world.cameras),
        default=WRIST_PIXEL,
    )


def _at_its_place_since(target: Primitive, stamp_ns: int) -> int:
    """Time [ns] since which the target stands at its place of `stamp_ns`; `stamp_ns` while it moves."""
    if target.track is None:
        return target.from_ns
    knots = [int(knot) for knot in target.track.stamp_ns if knot <= stamp_ns]
    places = [target.track.at(knot)[:3, 3] for knot in knots]
    here = target.track.at(stamp_ns)[:3, 3]
    still = [knot for knot, place in zip(knots, places, strict=True) if np.linalg.norm(place - here) < 1e-6]
    return still[0] if still else stamp_ns


def _widths(kind: str, size: tuple[float, ...]) -> tuple[float, ...]:
    """Extents [m] of a solid."""
    if kind == "box":
        return size
    return (2 * size[0],) if kind in ("sphere", "capsule") else (2 * size[0], size[1])
