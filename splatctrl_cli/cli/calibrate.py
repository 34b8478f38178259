"""``splatctrl calibrate``: camera poses against each other and the robot."""

import argparse
import math
from collections.abc import Iterator

from splatctrl_cli.cli.common import Console, request_of, table
from splatctrl_cli.config import fixed
from splatctrl_cli.jobs.calibrate import CalibrateRequest, CalibrateResult, calibrate


def run(args: argparse.Namespace, console: Console) -> int:
    result = calibrate(request_of(CalibrateRequest, args), console)
    return console.show(result, _lines(result))


def _lines(result: CalibrateResult) -> Iterator[str]:
    calibration = result.calibration
    free = [camera for name, camera in calibration.cameras.items() if not calibration.is_held(name)]
    sigma, turn = max(max(c.sigma_position) for c in free), math.degrees(max(max(c.sigma_rotation) for c in free))
    num_unsure = sum(bool(camera.unobserved) for camera in free)
    sure = f"each within {_mm(sigma)} and {turn:.2g} deg (one sigma)"
    unsure = f"{num_unsure} of them only in the directions that the recording shows"
    titles = ("camera", "moved mm", "turned deg", "sigma mm", "sigma deg", "depth", "")
    yield from (
        f"calibrate: {len(free)} of {len(calibration.cameras)} cameras placed, {unsure if num_unsure else sure}",
        "",
        *table(titles, [_row(result, name) for name in calibration.cameras]),
        "",
    )
    if result.before is not None and result.after is not None:
        before, after = _mm(result.before), _mm(result.after)
        yield f"points of a camera lie {after} from what another, or the robot, shows there (median); before {before}"
    if calibration.clock is not None:
        sign = f"{1e3 * calibration.clock:+.1f} ms"
        yield f"frames are stamped {sign} against the joint states (sigma {1e3 * calibration.sigma_clock:.1f} ms)"
    yield from (f"taken as recorded: {', '.join(calibration.as_recorded) or 'nothing'}", f"wrote {result.out}")


def _row(result: CalibrateResult, name: str) -> list[object]:
    camera, (distance, angle) = result.calibration.cameras[name], result.moved[name]
    unobserved = "; ".join(f"not observed: {text}" for text in camera.unobserved)
    remark = "held" if result.calibration.is_held(name) else unobserved
    noticed = 1e3 * camera.depth_noticed[1]
    depth = "as recorded" + (f" ({noticed:.0f} mm off would show)" if math.isfinite(noticed) else "")
    if (camera.scale, camera.bias) != (1.0, 0.0):
        depth = f"x {camera.scale:.4f}" + (f" {1e3 * camera.bias:+.1f} mm" if camera.bias else "")
    return [
        name,
        f"{1e3 * distance:.1f}",
        f"{angle:.2f}",
        f"{1e3 * max(camera.sigma_position):.2f}",
        f"{math.degrees(max(camera.sigma_rotation)):.3f}",
        depth,
        remark,
    ]


def _mm(metres: float) -> str:
    if metres >= fixed.CALIBRATION_REACHES[0]:  # farther is not compared
        return f"over {1e3 * fixed.CALIBRATION_REACHES[0]:.0f} mm"
    return f"{1e3 * metres:.2g} mm" if metres < 0.01 else f"{1e3 * metres:.1f} mm"
