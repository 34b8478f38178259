"""ScanNet's sensor files: ``X.sens`` of version 4, alone or in its folder.

Layout of ScanNet's SensReader (python/SensorData.py, c++/src/sensorData.h), little-endian: version (uint32), name
(uint64 and text), four 4x4 float32 matrices (intrinsics and extrinsics of colour, then depth); storage of colour and
depth (two int32), their sizes (four uint32), counts per metre (float32), number of frames (uint64). A frame: camera
to world (16 float32, -inf if lost), stamps of colour and depth [us] and lengths of both images (four uint64), the
images. IMU data follows, and is skipped.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.errors import refuse_faults, refuse_if
from splatctrl_cli.formats.image_file import MOST_PIXELS
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ImageFile,
    ImagePart,
    ListedView,
    PosesTable,
)
from splatctrl_cli.recording.folder.layout import (
    Layout,
    describe,
    find_marks,
    lens_option,
    list_views,
    move_poses,
    own_depth_camera,
    pinhole,
    pose_or_none,
)
from splatctrl_cli.recording.folder.poses import rigid
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64

SUFFIX, VERSION = ".sens", 4
_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_COLORS = {1: ".png", 2: ".jpg"}  # COMPRESSION_TYPE_COLOR that are image files
_RAW, _ZLIB = 0, 1  # of COMPRESSION_TYPE_DEPTH: words as they are, or packed
_HEAD, _FRAME = struct.Struct("<64f2i4If"), struct.Struct("<16f4Q")
_MOST_NAME = 1 << 16
_MOST_US = 1 << 51  # of a stamp that nanoseconds can hold
_AGAIN = "copy the file again"


@dataclass(frozen=True, kw_only=True)
class _Sens:
    """The head: both cameras' intrinsics (4, 4) [px] and poses in the rig's base.

    depth_scale: metres per count. is_packed: depth is zlib. first: byte of the first frame.
    """

    color: Float64
    depth: Float64
    T_base_color: Float64
    T_base_depth: Float64
    depth_scale: float
    color_suffix: str
    is_packed: bool
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    first: int
    num_frames: int


def read_sens(path: Path, options: SourceOptions) -> Description:
    files = [path] if path.is_file() else sorted(path.glob(f"*{SUFFIX}"))
    refuse_if(len(files) > 1, f"{path}: {len(files)} files *{SUFFIX}", remedy=f"give one of them, such as {files[0]}")
    file, root = files[0], files[0].parent
    sens = _head(file)
    frames = list(_frames(file, sens))
    refuse_if(not frames, f"{file}: expected frames, got none", remedy=_AGAIN)
    has_stamps = len({frame.stamp_ns for frame in frames}) == len(frames)
    views = frames if has_stamps else [replace(frame, stamp_ns=None) for frame in frames]
    missing = sens.num_frames - len(frames)
    color, depth = frames[0].color, frames[0].depth
    assert depth is not None
    lens = lens_option(options, color) or _lens(sens.color, color, f"{file} (colour)")
    return describe(
        move_poses(list_views(file, views, len(views), len(views)), lambda T: T @ sens.T_base_color),
        root,
        options,
        poses=PosesTable(format="sens", file=file.name),
        lens=lambda _: lens,
        depth_camera=own_depth_camera(
            lens,
            _lens(sens.depth, depth, f"{file} (depth)"),
            invert_transform(sens.T_base_color) @ sens.T_base_depth,
        ),
        depth=DepthTable(scale=sens.depth_scale),
        has_stamps=has_stamps,
        num_damaged=missing,
        notes=(f"{file.name}: ends after {len(frames)} of {sens.num_frames} frames",) if missing else (),
    )


def _lens(K: Float64, image: ImageFile, where: str) -> CameraTable:
    lens = pinhole((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), image)
    refuse_if(
        abs(2 * lens.cx - lens.width) > 0.25 * lens.width,
        f"{where}: cx {lens.cx:g} is not near the middle of {image.name}, {lens.width} columns wide",
        remedy="scale the intrinsics with the images, or give --intrinsics camera=FX,FY,CX,CY",
    )
    return lens


def _head(path: Path) -> _Sens:
    with path.open("rb") as stream:
        with refuse_faults(lambda _: f"{path}: ends within its head", struct.error, remedy=_AGAIN):
            version, length = struct.unpack("<IQ", stream.read(12))
            refuse_if(
                version != VERSION or length > _MOST_NAME,
                f"{path}: expected a sensor file of version {VERSION}, got {version}",
                remedy="export it with ScanNet's SensReader",
            )
            stream.read(length)
            *matrices, color, depth, wide, high, depth_wide, depth_high, shift = _HEAD.unpack(stream.read(_HEAD.size))
            (num_frames,) = struct.unpack("<Q", stream.read(8))
        first = stream.tell()
    refuse_if(
        color not in _COLORS or depth not in (_RAW, _ZLIB),
        f"{path}: expected colour as PNG or JPEG (1, 2) and depth as words, plain or zlib (0, 1), got {color} and"
        f" {depth}",
        remedy="export it with ScanNet's SensReader",
    )
    refuse_if(
        not (0 < shift < np.inf and 0 < depth_wide * depth_high <= MOST_PIXELS),
        f"{path}: expected counts per metre and a size of depth, got {shift} and {depth_wide}x{depth_high}",
        remedy=_AGAIN,
    )
    K_color, T_color, K_depth, T_depth = np.array(matrices, dtype=np.float64).reshape(4, 4, 4)
    return _Sens(
        color=K_color,
        depth=K_depth,
        T_base_color=rigid(T_color, f"{path}: extrinsic of colour"),
        T_base_depth=rigid(T_depth, f"{path}: extrinsic of depth"),
        depth_scale=1.0 / shift,
        color_suffix=_COLORS[color],
        is_packed=depth == _ZLIB,
        color_size=(wide, high),
        depth_size=(depth_wide, depth_high),
        first=first,
        num_frames=num_frames,
    )


def _frames(path: Path, sens: _Sens) -> Iterator[ListedView]:
    end = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(sens.first)
        for number in range(sens.num_frames):
            head = stream.read(_FRAME.size)
            if len(head) < _FRAME.size:
                return
            *pose, color_us, _, num_color, num_depth = _FRAME.unpack(head)
            first = stream.tell()
            if first + num_color + num_depth > end:
                return
            stream.seek(num_color + num_depth, 1)
            color, depth = partial(_part, path, first, num_color), partial(_part, path, first + num_color, num_depth)
            yield ListedView(
                name=f"{number:06d}",
                color=ImagePart(
                    file=path, number=number, size=sens.color_size, suffix=sens.color_suffix, read_bytes=color
                ),
                depth=ImagePart(
                    file=path,
                    number=number,
                    size=sens.depth_size,
                    suffix=".png",
                    read_bytes=partial(_png, depth, sens),
                ),
                matrix=pose_or_none(np.array(pose, dtype=np.float64).reshape(4, 4)),
                stamp_ns=color_us * 1000 if color_us < _MOST_US else None,
            )


def _part(path: Path, first: int, length: int) -> bytes:
    with path.open("rb") as stream:
        stream.seek(first)
        return stream.read(length)


def _png(read: Callable[[], bytes], sens: _Sens) -> bytes:
    data, (width, height) = read(), sens.depth_size
    num = 2 * width * height
    if sens.is_packed:
        try:
            data = zlib.decompressobj().decompress(data, num + 1)
        except zlib.error:
            return b""
    if len(data) != num:
        return b""
    return cv2.imencode(".png", np.frombuffer(data, "<u2").reshape(height, width), _FAST)[1].tobytes()


ENTRIES = (
    Layout(
        name="ScanNet sensor file",
        order=11,
        matches=find_marks(f"*{SUFFIX}"),
        read=read_sens,
        suffix=SUFFIX,
        docs="""
ScanNet sensor file | `X.sens` of version 4 | camera to world, -inf = none | `depthShift` counts per metre,
    registered to colour | of the file
""",
    ),
)
