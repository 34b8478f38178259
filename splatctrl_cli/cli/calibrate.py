"""``splatctrl calibrate``: where cameras stand against each other and the robot, and how sure that is."""

import argparse
import math
from collections.abc import Iterator

from splatctrl_cli.calibration.board import board_of
from splatctrl_cli.cli.common import Console, table
from splatctrl_cli.cli.options import locked_joints, request_of, source_options
from splatctrl_cli.config import fixed
from splatctrl_cli.jobs.calibrate import CalibrateRequest, CalibrateResult, CameraChange, calibrate


def run(args: argparse.Namespace) -> int:
    console = Console(args)
    request = request_of(
        CalibrateRequest,
        args,
        paths=tuple(args.source),
        options=source_options(args),
        locked=locked_joints(args),
        board=None if args.board is None else board_of(args.board),
    )
    result = calibrate(request, console)
    return console.result({"out": str(result.out), **result.metrics}, _lines(result))


def _lines(result: CalibrateResult) -> Iterator[str]:
    free = [change for change in result.changes if not change.is_held]
    sigma, turn = max(c.sigma_position for c in free), max(c.sigma_rotation for c in free)
    num_unsure = sum(bool(change.unobserved) for change in free)
    sure = f"each within {_mm(sigma)} and {turn:.2g} deg (one sigma)"
    unsure = f"{num_unsure} of them only in the directions that the recording shows"
    yield f"calibrate: {len(free)} of {len(result.changes)} cameras placed, {unsure if num_unsure else sure}"
    yield ""
    header = ("camera", "moved mm", "turned deg", "sigma mm", "sigma deg", "depth", "")
    yield from table(header, [_row(change) for change in result.changes])
    yield ""
    if result.before is not None and result.after is not None:
        before, after = _mm(result.before), _mm(result.after)
        yield f"points of a camera lie {after} from what another, or the robot, shows there (median); before {before}"
    calibration = result.calibration
    if calibration.clock is not None:
        sign = f"{1e3 * calibration.clock:+.1f} ms"
        yield f"frames are stamped {sign} against the joint states (sigma {1e3 * calibration.sigma_clock:.1f} ms)"
    yield f"taken as recorded: {', '.join(calibration.held) or 'nothing'}"
    yield f"wrote {result.out}"


def _row(change: CameraChange) -> list[object]:
    remark = "held" if change.is_held else "; ".join(f"not observed: {text}" for text in change.unobserved)
    depth = "as recorded"
    if math.isfinite(change.bias_noticed):
        depth += f" ({1e3 * change.bias_noticed:.0f} mm off would show)"
    if (change.scale, change.bias) != (1.0, 0.0):
        depth = f"x {change.scale:.4f}" + (f" {1e3 * change.bias:+.1f} mm" if change.bias else "")
    return [
        change.camera,
        f"{1e3 * change.distance:.1f}",
        f"{change.angle:.2f}",
        f"{1e3 * change.sigma_position:.2f}",
        f"{change.sigma_rotation:.3f}",
        depth,
        remark,
    ]


def _mm(metres: float) -> str:
    if metres >= fixed.CALIBRATION_REACHES[0]:  # farther is not compared
        return f"over {1e3 * fixed.CALIBRATION_REACHES[0]:.0f} mm"
    return f"{1e3 * metres:.2g} mm" if metres < 0.01 else f"{1e3 * metres:.1f} mm"
