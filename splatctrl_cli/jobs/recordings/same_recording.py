"""Whether a recording is the one that a scene was made from: intrinsics, stamps, poses and pictures of its cameras.

Cameras are called alike on every rig, so that names say nothing.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import SAME_LENS_PIXELS, SAME_PICTURE_LEVELS, SAME_POSE_DEGREES, SAME_POSE_METRES
from splatctrl_cli.geometry import compare_poses
from splatctrl_cli.records import Record, RgbdFrame, UInt8

TILES = (6, 8)  # rows and columns of the picture that is kept of a first frame


@dataclass(frozen=True, kw_only=True)
class FirstFrame:
    """What ``run.json`` keeps of the first frame that a camera trained with.

    intrinsics: fx, fy, cx, cy, width, height [px]; T_world_camera: 16 numbers by row; tiles: mean colours (0 to 255)
    of a coarse picture.
    """

    camera: str
    stamp_ns: int
    intrinsics: list[float]
    T_world_camera: list[float]
    tiles: list[float]

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def first_frame(frame: RgbdFrame) -> FirstFrame:
    k = frame.intrinsics
    return FirstFrame(
        camera=frame.camera,
        stamp_ns=frame.stamp_ns,
        intrinsics=[k.fx, k.fy, k.cx, k.cy, float(k.width), float(k.height)],
        T_world_camera=[round(float(value), 9) for value in frame.T_world_camera.ravel()],
        tiles=[round(value, 1) for value in _tiles(frame.color)],
    )


def differences(recorded: Sequence[Mapping[str, Any]], records: Iterator[Record]) -> list[str]:
    """In words with figures, how `records` differ from a scene's first frames `recorded`; empty where they agree.

    Reads until each frame was met, or passed by.
    """
    wanted = {str(first["camera"]): first for first in recorded}
    last = max(int(first["stamp_ns"]) for first in recorded)
    nearest: dict[str, RgbdFrame] = {}
    for record in records:
        if not isinstance(record, RgbdFrame) or record.camera not in wanted:
            continue
        stamp_ns = int(wanted[record.camera]["stamp_ns"])
        best = nearest.get(record.camera)
        if best is None or abs(record.stamp_ns - stamp_ns) < abs(best.stamp_ns - stamp_ns):
            nearest[record.camera] = record
        if record.stamp_ns >= last and len(nearest) == len(wanted):
            break
    lines = []
    for camera, first in wanted.items():
        found = nearest.get(camera)
        lines += [f"has no camera {camera}"] if found is None else _differences(first, found)
    return lines


def changed_files(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """In words, which files have the name but not the digest of `then`; descriptions (.toml) may change."""
    common = [name for name in then if name in now and not name.endswith(".toml")]
    changed = [name for name in common if then[name] != now[name]]
    if not changed:
        return []
    if len(common) == 1:
        return [f"{changed[0]} has other contents"]
    return [f"{len(changed)} of {len(common)} files have other contents, such as {changed[0]}"]


def _differences(first: Mapping[str, Any], frame: RgbdFrame) -> list[str]:
    camera, lines = frame.camera, []
    then, now = np.array(first["intrinsics"], np.float64), np.array(first_frame(frame).intrinsics)
    if then[4:].tolist() != now[4:].tolist():
        return [f"{camera}: images of {now[4]:g}x{now[5]:g}, not {then[4]:g}x{then[5]:g}"]
    gap = float(np.abs(then[:4] - now[:4]).max())
    if gap > SAME_LENS_PIXELS:
        lines.append(f"{camera}: intrinsics differ by {gap:.1f} px")
    apart = (frame.stamp_ns - int(first["stamp_ns"])) * 1e-9
    if apart:
        side = "after" if apart > 0 else "before"
        lines.append(f"{camera}: its nearest frame is {abs(apart):.3g} s {side} the one that trained")
    then_pose = np.array(first["T_world_camera"], np.float64).reshape(4, 4)
    metres, degrees = compare_poses(then_pose, frame.T_world_camera)
    if metres > SAME_POSE_METRES or degrees > SAME_POSE_DEGREES:
        lines.append(f"{camera}: the pose differs by {1e3 * metres:.0f} mm and {degrees:.1f} degrees")
    levels = float(np.abs(np.array(first["tiles"]) - np.array(_tiles(frame.color))).max())
    if levels > SAME_PICTURE_LEVELS:
        lines.append(f"{camera}: the picture differs by up to {levels:.0f} of 255 levels")
    return lines


def _tiles(color: UInt8) -> list[float]:
    """Mean colour of each tile, by row."""
    rows, columns = (
        np.linspace(0, size, num + 1).astype(int) for size, num in zip(color.shape[:2], TILES, strict=True)
    )
    return [
        float(value)
        for top, bottom in zip(rows[:-1], np.maximum(rows[1:], rows[:-1] + 1), strict=True)
        for left, right in zip(columns[:-1], np.maximum(columns[1:], columns[:-1] + 1), strict=True)
        for value in color[top:bottom, left:right].reshape(-1, 3).mean(axis=0)
    ]
