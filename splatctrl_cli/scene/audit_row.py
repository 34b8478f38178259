"""What a time step, and the refining of a scene that stands still, report of themselves."""

from dataclasses import dataclass, field

from splatctrl_cli.scene.buffer import Filled


@dataclass(frozen=True, kw_only=True)
class AuditRow:
    """What one time step did: counts of splats, loss (eq. 4) and PSNR [dB] over the newest frames, each as the last
    iteration that looked at it found it.

    dead: slots that wait to be reused. unmet: seeds that found no slot. evicted: splats that gave theirs to surface
    without any. unrepresented: occupied voxels that no splat stands for. without_depth: frames without any valid
    depth, which seed nothing. loss and psnr are None where no view shows anything of the workspace. self_mask: by
    link, measured less rendered depth over the pixels within the robot's outline: `median_mm`, its `sign` and
    `num_pixels`. inside_robot: by link, measured points inside it that its surface does not explain. blind: cameras
    without any valid depth.
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
    """How far refining has come: blocks done, where their seeds went, and what they removed by reason."""

    num_blocks: int
    filled: Filled
    removed: dict[str, int]
