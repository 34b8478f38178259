"""``--twist-topic``: the velocity that a log's own operator asked for, as what a replay's controller reaches for."""

from collections.abc import Mapping, Sequence

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.audit import Stamps
from splatctrl_cli.control.goals import TwistTrack
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.jobs.progress import Progress
from splatctrl_cli.jobs.replay_request import ReplayRequest
from splatctrl_cli.records import FloatRows
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.states.twists import read_twists

WORLD = "world"
FIGURES = (
    *("twist_share", "twist_share_capped", "mean_twist_error_linear", "max_twist_error_linear"),
    *("mean_twist_error_angular", "max_twist_error_angular"),
)


def check_twists(request: ReplayRequest) -> None:
    """Raise UsageError for twists where no controller runs, or a frame without them."""
    if request.twist_topic is not None and request.mode == "audit":
        raise UsageError("--twist-topic: expected --mode open-loop or closed-loop", remedy="an audit asks nobody")
    if request.twist_frame is not None and request.twist_topic is None:
        raise UsageError("--twist-frame: expected --twist-topic", remedy="leave it out")


def twist_track(
    request: ReplayRequest, model: "RobotModel", span_ns: tuple[int, int], console: Progress
) -> "TwistTrack | None":
    """The twists that --twist-topic names, None without it. span_ns: first and last joint state.

    Raises InputError where they are in no frame that is known, or all at other times.
    """

    if request.twist_topic is None:
        return None
    logged = read_twists(request.log, request.twist_topic)
    frame = logged.frame if request.twist_frame is None else request.twist_frame
    if frame != WORLD and frame not in model.frame_names:
        raise InputError(
            f"{logged.where}: expected twists in world or a link of the robot, got frame {frame!r}",
            remedy=f"give --twist-frame, one of: world, {', '.join(model.frame_names)}",
        )
    first, last = int(logged.stamp_ns[0]), int(logged.stamp_ns[-1])
    if last < span_ns[0] or first > span_ns[1]:
        raise InputError(
            f"{logged.where}: mixed clocks: expected twists between the joint states' stamps {span_ns[0]} and "
            f"{span_ns[1]} ns, got {first} to {last} ns",
            remedy="record both by one clock",
        )
    from_s, to_s = ((stamp - span_ns[0]) * 1e-9 for stamp in (first, last))
    console.log(f"replay: {len(logged.stamp_ns)} twists in {frame}, {from_s:.2f} to {to_s:.2f} s of the log")
    for note in logged.notes:
        console.log(f"replay: {request.twist_topic}: {note}")
    return TwistTrack(stamp_ns=logged.stamp_ns, twist=logged.twist, axes=None if frame == WORLD else frame)


def twist_figures(
    model: "ArmModel",
    config: "ControlConfig",
    frame: str,
    track: "TwistTrack | None",
    stamp_ns: "Stamps",
    position: "FloatRows",
    steps: "Sequence[ControlStep | None]",
) -> Mapping[str, float | None]:
    """`FIGURES` of a controller's T steps: the share of states where a twist holds, the share of these where it was
    capped, and by how much [m/s, rad/s] the commanded twist misses it. Empty without twists.
    """

    if track is None:
        return {}
    is_known = track.is_known(stamp_ns, config.twist_timeout)
    num_known = num_capped = 0
    linear, angular = np.full(len(stamp_ns), np.nan), np.full(len(stamp_ns), np.nan)
    for i, (stamp, q, step, known) in enumerate(zip(stamp_ns, position, steps, is_known, strict=True)):
        reference = track.reference(model, config, q, int(stamp))
        if known:
            num_known += 1
            asked = track.asked(model, q, int(stamp), config.twist_timeout)
            num_capped += not np.array_equal(reference, asked)
        if step is not None:
            missed = model.frame_jacobian(q, frame) @ step.velocity - reference
            linear[i], angular[i] = np.linalg.norm(missed[:3]), np.linalg.norm(missed[3:])
    values = [float(is_known.mean()), num_capped / num_known if num_known else None]
    for errors in (linear[~np.isnan(linear)], angular[~np.isnan(angular)]):
        values += [float(np.mean(errors)), float(np.max(errors))] if len(errors) else [None, None]
    return dict(zip(FIGURES, values, strict=True))
