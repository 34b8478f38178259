"""Time steps from records, the workspace's box, and a step's report."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatctrl_cli.config.fixed import FRAMES_PER_STEP, JOINTS_GAP_NS
from splatctrl_cli.errors import refuse_if
from splatctrl_cli.records import Box, Float32, Float64, JointState, PointCloud, Record, RgbdFrame
from splatctrl_cli.scene.buffer import Filled
from splatctrl_cli.scene.seeding import thin_mask, thinning, world_points


@dataclass(frozen=True, kw_only=True)
class TimeStep:
    """Frames taken together (with a clock, one per camera), and joint positions.

    position (J,): at the last frame, in the source's joint order; None without a joint state within `JOINTS_GAP_NS`.
    velocity (J,) [1/s].
    """

    frames: tuple[RgbdFrame, ...]
    position: Float64 | None
    velocity: Float64 | None = None

    @property
    def positions(self) -> dict[int, Float64]:
        """Joint positions (J,) by frame stamp [ns]; empty without `position`."""
        if self.position is None or self.velocity is None:
            return {}
        last_ns = self.frames[-1].stamp_ns
        return {
            frame.stamp_ns: self.position + 1e-9 * (frame.stamp_ns - last_ns) * self.velocity for frame in self.frames
        }

    def drop_depth(self) -> "TimeStep":
        """The step as colour cameras would see it."""
        return replace(self, frames=tuple(replace(frame, depth=np.zeros_like(frame.depth)) for frame in self.frames))

    @property
    def stamp_ns(self) -> int:
        return max(frame.stamp_ns for frame in self.frames)

    @property
    def has_depth(self) -> bool:
        return any(bool((frame.depth > 0).any()) for frame in self.frames)


@dataclass(frozen=True, kw_only=True)
class AuditRow:
    """Result of one time step.

    Counts are of splats. loss (eq. 4), psnr [dB]: of the newest frames at their last iteration, None if none shows
    the workspace. dead: reusable slots. unmet: seeds without a slot. evicted: slots given to bare surface.
    unrepresented: voxels. without_depth: frames; blind: their cameras. self_mask: by link, measured minus rendered
    depth: `median_mm`, its `sign`, `num_pixels`. inside_robot: by link, unexplained points inside.
    """

    stamp_ns: int
    cameras: tuple[str, ...]
    alive: int
    dead: int
    added: int
    relocated: int
    unmet: int
    evicted: int
    removed: dict[str, int]
    robot: int
    human: int
    unrepresented: int
    without_depth: int
    loss: float | None
    psnr: float | None
    self_mask: dict[str, dict[str, float]] = field(default_factory=dict)
    inside_robot: dict[str, int] = field(default_factory=dict)
    blind: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Refined:
    """Progress of refining: blocks done, seeds, removals by reason."""

    num_blocks: int
    filled: Filled
    removed: dict[str, int]


def time_steps(
    records: Iterator[Record],
    cameras: Collection[str],
    *,
    has_clock: bool,
    tolerance_ns: int = 20_000_000,
    observe: Callable[[Record], None] = lambda record: None,
    repeats: Counter[str] | None = None,
) -> Iterator[TimeStep]:
    """Group frames of `cameras` by stamp; without a clock, FRAMES_PER_STEP at a time.

    With a clock, a frame whose depth equals its camera's last depth is skipped, and counted in `repeats` by camera.
    `observe` gets every record.
    """
    last_depth: dict[str, Float32] = {}
    frames: list[RgbdFrame] = []
    newest: JointState | None = None
    at_frames: JointState | None = None
    for record in records:
        observe(record)
        if isinstance(record, JointState):
            newest = record
            continue
        if record.camera not in cameras:
            continue
        before = last_depth.get(record.camera)
        last_depth[record.camera] = record.depth
        if has_clock and before is not None and before.any() and np.array_equal(before, record.depth):
            if repeats is not None:
                repeats[record.camera] += 1
            continue
        if frames and _is_complete(frames, record, has_clock=has_clock, tolerance_ns=tolerance_ns):
            yield _time_step(frames, at_frames)
            frames = []
        frames.append(record if has_clock else planar(record))
        at_frames = newest
    if frames:
        yield _time_step(frames, at_frames)


def planar(frame: RgbdFrame) -> RgbdFrame:
    """Frame with colour stored by plane, so that the optimiser's views share its memory."""
    planes = np.ascontiguousarray(np.moveaxis(frame.color, 2, 0))
    return replace(frame, color=np.moveaxis(planes, 0, 2))


def _is_complete(frames: Sequence[RgbdFrame], record: RgbdFrame, *, has_clock: bool, tolerance_ns: int) -> bool:
    if not has_clock:
        return len(frames) >= FRAMES_PER_STEP
    is_later = record.stamp_ns - frames[0].stamp_ns > tolerance_ns
    return is_later or any(frame.camera == record.camera for frame in frames)


def _time_step(frames: Sequence[RgbdFrame], joints: JointState | None) -> TimeStep:
    position = velocity = None
    if joints is not None and abs(frames[-1].stamp_ns - joints.stamp_ns) <= JOINTS_GAP_NS:
        elapsed = (frames[-1].stamp_ns - joints.stamp_ns) * 1e-9
        velocity = np.nan_to_num(joints.velocity)
        position = joints.position + elapsed * velocity
    return TimeStep(frames=tuple(frames), position=position, velocity=velocity)


def cloud_box(cloud: PointCloud) -> Box:
    """Box of a cloud, widened by 5 % and 5 cm per side."""
    lower, upper = cloud.points.min(axis=0).astype(np.float64), cloud.points.max(axis=0).astype(np.float64)
    margin = 0.05 * (upper - lower) + 0.05
    return Box(lower=lower - margin, upper=upper + margin)


def depth_box(frames: Sequence[RgbdFrame], max_range: float, scale: float = 1.0) -> Box:
    """Box of valid depth up to `max_range` [m], without the outer 0.5 % per side.

    It is widened by 2 % and 2 cm times `scale`. Raises InputError without valid depth.
    """
    masks = [(frame.depth > 0) & (frame.depth <= max_range) for frame in frames]
    every = thinning(masks)
    points = [world_points(frame, thin_mask(mask, every)) for frame, mask in zip(frames, masks, strict=True)]
    joined = np.concatenate(points)
    del points
    names = ", ".join(sorted({frame.camera for frame in frames}))
    refuse_if(
        not len(joined),
        f"camera {names}: no valid depth within {max_range} m in the first frames",
        remedy="check the depth topic and scale, raise occupancy.max_range, or give a --box",
    )
    lower, upper = np.percentile(joined, [0.5, 99.5], axis=0)
    margin = 0.02 * (upper - lower) + 0.02 * scale
    return Box(lower=lower - margin, upper=upper + margin)
