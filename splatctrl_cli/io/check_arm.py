"""Whether depth images show the arm where forward kinematics puts it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.io.check_images import KeptDepth, strided_lens
from splatctrl_cli.io.finding import Finding, note, warning
from splatctrl_cli.io.state_motion import CameraMotion, silhouettes
from splatctrl_cli.records import Float32, Float64, Intrinsics, JointState
from splatctrl_cli.robot.model import RobotModel

NEAR = 0.10  # [m] of the predicted depth within which a pixel shows the arm
BEHIND = 0.10  # [m] beyond the spheres: something else is seen where the arm should be
MAX_OFFSET = 0.03  # [m]; covering spheres stand before the surface by one or two centimetres
MAX_SEEN_THROUGH = 0.25  # of the arm's pixels
MIN_PIXELS = 200
CLOSE_NS = 100_000_000  # between a frame and the joint states around it


@dataclass(frozen=True, kw_only=True)
class ArmAgreement:
    """Depth minus the depth of the robot's spheres, over the pixels that they cover, frame by frame.

    median [m] of those within `NEAR`, positive where the surface lies behind the spheres' own; seen_through: share of
    the pixels whose depth lies more than `BEHIND` behind; num_pixels with depth; num_frames that show the arm.
    """

    median: float
    seen_through: float
    num_pixels: int
    num_frames: int


def arm_agreement(
    model: RobotModel,
    lens: Intrinsics,
    posed: Sequence[tuple[KeptDepth, Float64]],
    states: Sequence[JointState],
    stamps_ns: "np.ndarray[tuple[int], np.dtype[np.int64]]",
) -> ArmAgreement | None:
    """Of one camera's kept depth images, each with T_world_camera (4, 4); None where too little of the arm is seen.

    states: by stamp, in the model's joint order; stamps_ns (T,) are theirs.
    """
    parts: list[Float64] = []
    for kept, T_world_camera in posed:
        q = _posture(states, stamps_ns, kept.stamp_ns)
        if q is None:
            continue
        camera = CameraMotion(intrinsics=strided_lens(lens, kept), T_world_camera=T_world_camera)
        centers = model.sphere_centers(q)
        predicted: Float32 = silhouettes(centers[None], model.sphere_set.radii, camera)[0]
        both = (predicted > 0) & (kept.depth > 0)
        if both.any():
            parts.append((kept.depth[both] - predicted[both]).astype(np.float64))
    offsets = np.concatenate(parts) if parts else np.zeros(0)
    visible = offsets[offsets > -NEAR]  # what is nearer by more hides the arm
    near = visible[visible < NEAR]
    if len(visible) < MIN_PIXELS:
        return None
    return ArmAgreement(
        median=float(np.median(near)) if len(near) else float("inf"),
        seen_through=float((visible > BEHIND).mean()),
        num_pixels=len(visible),
        num_frames=len(parts),
    )


def arm_findings(where: str, agreement: ArmAgreement) -> list[Finding]:
    """One sentence: the arm is where the depth images show it, or not."""
    share = f"{100 * agreement.seen_through:.0f} % of {agreement.num_pixels} pixels of the arm"
    seen = f"in {agreement.num_frames} depth images {share} show what is behind it"
    is_through = agreement.seen_through > MAX_SEEN_THROUGH
    if is_through or abs(agreement.median) > MAX_OFFSET:
        rest = f"; the others are {1e3 * agreement.median:+.0f} mm off" if np.isfinite(agreement.median) else ""
        remedy = "check the URDF, --base, the camera's pose and the clocks; robot labels will be wrong"
        value = 1e3 * agreement.median if np.isfinite(agreement.median) else None
        text = f"the arm is not where the joints say: {seen}{rest}"
        return [warning("arm", where, text, remedy, value=value, unit="mm")]
    text = f"depth shows the arm {1e3 * agreement.median:+.0f} mm behind its spheres (median); {seen}"
    return [note("arm", where, text, value=1e3 * agreement.median, unit="mm")]


def _posture(
    states: Sequence[JointState], stamps_ns: "np.ndarray[tuple[int], np.dtype[np.int64]]", stamp_ns: int
) -> Float64 | None:
    """Joint positions at a time, linearly between states; None where they are too far away."""
    after = int(np.searchsorted(stamps_ns, stamp_ns))
    near = [i for i in (after - 1, after) if 0 <= i < len(states) and abs(int(stamps_ns[i]) - stamp_ns) <= CLOSE_NS]
    if not near:
        return None
    if len(near) == 1:
        return states[near[0]].position
    before, later = states[near[0]], states[near[1]]
    share = (stamp_ns - before.stamp_ns) / max(later.stamp_ns - before.stamp_ns, 1)
    return np.asarray((1 - share) * before.position + share * later.position)
