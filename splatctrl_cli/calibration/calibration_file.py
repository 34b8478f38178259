"""``calibration.toml``: camera poses, depth and clock corrections, and their certainty."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import refuse_faults, refuse_if
from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.formats.unpacking import read_toml
from splatctrl_cli.geometry import quat_from_rotation, transform_from
from splatctrl_cli.records import Float64

FORMAT, VERSION = "splatctrl-calibration", 1
AGAIN = "write it again with `splatctrl calibrate`"


@dataclass(frozen=True, kw_only=True)
class CalibratedCamera:
    """One camera of a rig.

    T (4, 4): T_world_camera if stationary, T_recorded_camera if moving. recorded (4, 4): the recording's
    T_world_camera, None if moving. scale, bias [m]: the true depth is ``scale depth + bias``. sigma_position (3,)
    [m], sigma_rotation (3,) [rad]: along the world's axes, or a moving camera's own. sigma_depth: of scale and bias
    [m]. depth_noticed: the least noticeable |scale - 1| and |bias| [m], or inf. as_recorded: parts not solved for.
    unobserved: directions kept as recorded.
    """

    T: Float64
    recorded: Float64 | None
    scale: float = 1.0
    bias: float = 0.0
    sigma_position: tuple[float, ...] = (0.0, 0.0, 0.0)
    sigma_rotation: tuple[float, ...] = (0.0, 0.0, 0.0)
    sigma_depth: tuple[float, ...] = (0.0, 0.0)
    depth_noticed: tuple[float, ...] = (math.inf, math.inf)
    covariance: Float64 = field(default_factory=lambda: np.zeros((6, 6)))
    as_recorded: tuple[str, ...] = ()
    unobserved: tuple[str, ...] = ()

    @property
    def moves(self) -> bool:
        return self.recorded is None


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """The calibration of a recording.

    clock [s]: a frame's stamp minus the joint state's at that instant; None if not solved for. digests: sha256 by
    file.
    """

    recording: str
    world_frame: str
    digests: Mapping[str, str]
    cameras: Mapping[str, CalibratedCamera]
    as_recorded: tuple[str, ...] = ()
    clock: float | None = None
    sigma_clock: float = 0.0

    def is_held(self, camera: str) -> bool:
        """True if the camera's pose stayed as recorded."""
        return f"camera {camera}" in self.as_recorded


def calibration_text(calibration: Calibration) -> str:
    lines = [
        f"format = {_text(FORMAT)}",
        f"version = {VERSION}",
        f"recording = {_text(calibration.recording)}",
        f"world_frame = {_text(calibration.world_frame)}",
        f"held = {_list(map(_text, calibration.as_recorded))}  # taken as recorded",
    ]
    if calibration.clock is not None:
        meaning = "# [s] a frame's stamp less that of the joint state at that instant"
        lines += ["", "[clock]", f"offset = {calibration.clock!r}  {meaning}", f"sigma = {calibration.sigma_clock!r}"]
    for name, camera in calibration.cameras.items():
        where = "T_recorded_camera" if camera.moves else "T_world_camera"
        axes = "its own" if camera.moves else "the world's"
        poses = {"mount" if camera.moves else "pose": camera.T, "recorded": camera.recorded}
        texts = {
            key: _numbers([*T[:3, 3], *quat_from_rotation(T[:3, :3])]) for key, T in poses.items() if T is not None
        }
        pose, *recorded = (f"{key} = {text}" for key, text in texts.items())
        lines += [
            "",
            f"[cameras.{_text(name)}]",
            f"{pose}  # {where}: x, y, z [m], qx, qy, qz, qw",
            *recorded,
            f"depth_scale = {float(camera.scale)!r}",
            f"depth_bias = {float(camera.bias)!r}  # [m]",
            f"sigma_position = {_numbers(camera.sigma_position)}  # [m], along {axes} axes",
            f"sigma_rotation = {_numbers(camera.sigma_rotation)}  # [rad], about {axes} axes",
            f"sigma_depth = {_numbers(camera.sigma_depth)}  # of depth_scale and depth_bias [m]",
            f"depth_noticed = {_numbers(camera.depth_noticed)}  # off by less, they would be taken as recorded",
            f"held = {_list(map(_text, camera.as_recorded))}",
            f"unobserved = {_list(map(_text, camera.unobserved))}",
            f"covariance = {_list(_numbers(row) for row in camera.covariance)}  # of position, rotation",
        ]
    lines += [
        "",
        "[digests]  # sha256 of the recording",
        *(f"{_text(k)} = {_text(v)}" for k, v in calibration.digests.items()),
    ]
    return "\n".join(lines) + "\n"


def read_calibration(path: Path) -> Calibration:
    """Read a calibration. Raises InputError for a missing, another or a damaged file."""
    content = read_toml(path, AGAIN)
    refuse_if(
        content.get("format") != FORMAT,
        f"{path}: expected a calibration, got another file",
        remedy="give what calibrate wrote",
    )
    refuse_if(
        content.get("version") != VERSION,
        f"{path}: expected version {VERSION}, got {content.get('version')}",
        remedy="use a newer splatctrl",
    )
    with refuse_faults(
        lambda error: f"{path}: damaged: {type(error).__name__}: {error}",
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
        remedy=AGAIN,
    ):
        clock = content.get("clock")
        return Calibration(
            recording=str(content["recording"]),
            world_frame=str(content["world_frame"]),
            digests={str(name): str(value) for name, value in content["digests"].items()},
            cameras={str(name): _camera(entry) for name, entry in content["cameras"].items()},
            as_recorded=tuple(map(str, content["held"])),
            clock=None if clock is None else _finite([clock["offset"]], 1)[0],
            sigma_clock=0.0 if clock is None else _finite([clock["sigma"]], 1)[0],
        )


def is_calibration(path: Path) -> bool:
    """True if a file begins as a calibration."""
    with path.open("rb") as stream:
        return stream.read(64).startswith(f"format = {_text(FORMAT)}".encode())


def describe_calibration(path: Path) -> Summary:
    calibration = read_calibration(path)
    rows = [
        [
            name,
            "moves" if camera.moves else "stands still",
            f"{1e3 * max(camera.sigma_position):.2f}",
            f"{np.degrees(max(camera.sigma_rotation)):.3f}",
            f"{camera.scale:.5g}",
            f"{1e3 * camera.bias:.1f}",
            "; ".join((*camera.as_recorded, *(f"not observed: {text}" for text in camera.unobserved))) or "-",
        ]
        for name, camera in calibration.cameras.items()
    ]
    header = ("camera", "", "sigma mm", "sigma deg", "depth scale", "depth bias mm", "held")
    facts: dict[str, object] = {
        "recording": calibration.recording,
        "world_frame": calibration.world_frame,
        "held": list(calibration.as_recorded),
        "clock_offset_s": calibration.clock,
    }
    return Summary(
        path=str(path), kind="calibration", facts=facts, grids=(Grid(name="cameras", header=header, rows=rows),)
    )


def _camera(entry: Mapping[str, Any]) -> CalibratedCamera:
    moves = "mount" in entry
    scale, bias = _finite([entry["depth_scale"], entry["depth_bias"]], 2)
    refuse_if(not 0.01 < scale < 100, f"depth_scale: {scale}", error=ValueError)
    covariance = np.array([_finite(row, 6) for row in entry["covariance"]])
    refuse_if(covariance.shape != (6, 6), "covariance: expected 6 rows", error=ValueError)
    return CalibratedCamera(
        T=_pose(entry["mount" if moves else "pose"]),
        recorded=None if moves else _pose(entry["recorded"]),
        scale=scale,
        bias=bias,
        sigma_position=_finite(entry["sigma_position"], 3),
        sigma_rotation=_finite(entry["sigma_rotation"], 3),
        sigma_depth=_finite(entry["sigma_depth"], 2),
        depth_noticed=tuple(map(float, entry["depth_noticed"])),
        covariance=covariance,
        as_recorded=tuple(map(str, entry["held"])),
        unobserved=tuple(map(str, entry["unobserved"])),
    )


def _finite(values: Sequence[Any], count: int) -> tuple[float, ...]:
    numbers = tuple(float(value) for value in values)
    refuse_if(
        len(numbers) != count or not np.isfinite(numbers).all(),
        f"expected {count} finite numbers, got {list(values)}",
        error=ValueError,
    )
    return numbers


def _pose(values: Sequence[Any]) -> Float64:
    numbers = _finite(values, 7)
    refuse_if(
        abs(np.linalg.norm(numbers[3:]) - 1) > 1e-3,
        f"expected a unit quaternion, got {list(numbers[3:])}",
        error=ValueError,
    )
    return transform_from(numbers[:3], numbers[3:])


def _numbers(values: Any) -> str:
    return _list(repr(float(value)) for value in values)


def _list(texts: Any) -> str:
    return f"[{', '.join(texts)}]"


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
