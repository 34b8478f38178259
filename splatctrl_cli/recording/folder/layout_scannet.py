"""ScanNet, as its SensReader exports it and in its sensor files.

ScanNet as its SensReader exports it, and the calibration that its sensor files (.sens) carry.

The export: ``color/``, ``depth/``, ``pose/`` and ``intrinsic/``; numbers in the names, depth in millimetres in a
camera of its own, poses camera to world with -inf where tracking was lost (SensReader/python/SensorData.py). The
subset scannet_frames_25k has ``intrinsics_color.txt`` and ``intrinsics_depth.txt`` instead of the last folder.

The calibration, in those files or in the ``info.txt`` beside the frames: fields and their meaning are those of
ScanNet's SensReader (c++/src/sensorData.h): intrinsics 4x4; an extrinsic maps its camera to the rig's base frame,
which is usually the colour camera; depthShift is counts per metre. 12-Scenes, BundleFusion and 3RScan publish it too.

ScanNet's sensor files: ``X.sens`` of version 4, by itself or in its folder.

As ScanNet's SensReader reads it (python/SensorData.py, c++/src/sensorData.h), little-endian: version (uint32), name
(uint64 and text), four 4x4 float32 matrices (intrinsics and extrinsics of colour, then of depth), two int32 of how
colour and depth are stored, their sizes (four uint32), counts per metre (float32), number of frames (uint64). A
frame: camera to world (16 float32, -inf where tracking was lost), stamps of colour and depth [us] and lengths of both
images (four uint64), the images. What follows the frames (IMU) is passed over.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.errors import InputError
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
    Pairs,
    described,
    given_lens,
    images_of,
    marked,
    own_depth_camera,
    paired_by_name,
    pinhole,
    pose_or_none,
    read_pose,
)
from splatctrl_cli.recording.folder.poses import read_matrix_file, rigid
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import MILLIMETRE, Float64

INFO_NAMES = ("_info.txt", "info.txt")
_IMAGES = "color/ depth/ pose/"


@dataclass(frozen=True, kw_only=True)
class SensCalibration:
    """Lenses of both cameras (4, 4) [px], where they are in the rig's base, and metres per count of depth."""

    color: Float64
    depth: Float64
    T_base_color: Float64
    T_base_depth: Float64
    depth_scale: float = MILLIMETRE
    where: str = ""

    def cameras(
        self, color_image: ImageFile, depth_image: ImageFile, options: SourceOptions
    ) -> tuple[CameraTable, CameraTable | None]:
        """Colour and depth camera, of the sizes of two images; no depth camera where both are one.

        Raises InputError where a lens cannot be that of its image.
        """
        color = given_lens(options, color_image) or _lens(self.color, color_image, f"{self.where} (colour)")
        depth = _lens(self.depth, depth_image, f"{self.where} (depth)")
        return color, own_depth_camera(color, depth, invert_transform(self.T_base_color) @ self.T_base_depth)


def read_text_files(folder: Path) -> SensCalibration:
    """From ``intrinsic/intrinsic_color.txt`` and its kin (SensorData.py), or ``intrinsics_color.txt`` beside the
    images (scannet_frames_25k), which has no extrinsics.
    """
    inner = folder / "intrinsic"
    if inner.is_dir():
        names = ("intrinsic_color", "intrinsic_depth", "extrinsic_color", "extrinsic_depth")
    else:
        inner, names = folder, ("intrinsics_color", "intrinsics_depth", "extrinsics_color", "extrinsics_depth")
    files = [inner / f"{name}.txt" for name in names]
    extrinsics = [rigid(read_matrix_file(file), str(file)) if file.is_file() else np.eye(4) for file in files[2:]]
    return SensCalibration(
        color=read_matrix_file(files[0]),
        depth=read_matrix_file(files[1]),
        T_base_color=extrinsics[0],
        T_base_depth=extrinsics[1],
        where=str(inner),
    )


def find_info(folder: Path) -> Path | None:
    """The ``info.txt`` of a folder or of one above it."""
    return next((path for name in INFO_NAMES for f in (folder, folder.parent) if (path := f / name).is_file()), None)


def read_info(path: Path) -> SensCalibration:
    """From ``NAME = VALUES`` lines. Raises InputError where one that is needed is not there."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    values = {name.strip(): text.split() for name, _, text in (line.partition("=") for line in lines)}

    def matrix(name: str, default: Float64 | None = None) -> Float64:
        if name not in values and default is not None:
            return default
        return np.array([float(word) for word in values[name]]).reshape(4, 4)

    try:
        return SensCalibration(
            color=matrix("m_calibrationColorIntrinsic"),
            depth=matrix("m_calibrationDepthIntrinsic"),
            T_base_color=rigid(
                matrix("m_calibrationColorExtrinsic", np.eye(4)), f"{path}: m_calibrationColorExtrinsic"
            ),
            T_base_depth=rigid(
                matrix("m_calibrationDepthExtrinsic", np.eye(4)), f"{path}: m_calibrationDepthExtrinsic"
            ),
            depth_scale=1.0 / float(values["m_depthShift"][0]) if "m_depthShift" in values else MILLIMETRE,
            where=str(path),
        )
    except (KeyError, ValueError, IndexError, ZeroDivisionError) as error:
        raise InputError(
            f"{path}: expected m_calibrationColorIntrinsic and m_calibrationDepthIntrinsic of 16 numbers each, got no"
            f" usable {error}",
            remedy="copy the file again, or give --intrinsics camera=FX,FY,CX,CY",
        ) from None


def _lens(K: Float64, image: ImageFile, where: str) -> CameraTable:
    lens = pinhole((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), image)
    if abs(2 * lens.cx - lens.width) > 0.25 * lens.width:
        raise InputError(
            f"{where}: cx {lens.cx:g} is not near the middle of {image.name}, {lens.width} columns wide",
            remedy="scale the intrinsics with the images, or give --intrinsics camera=FX,FY,CX,CY",
        )
    return lens


def read_scannet(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; depth is registered to colour unless both are the same camera."""
    colors, depths = images_of(folder / "color"), images_of(folder / "depth")
    calibration = read_text_files(folder)
    pairs = paired_by_name(folder, colors, depths, lambda name: read_pose(folder / "pose" / f"{name}.txt"))
    first = pairs.views[0]
    lens, depth_camera = calibration.cameras(first.color, depths[first.name], options)
    return described(
        pairs.moved(lambda T: T @ calibration.T_base_color),
        folder,
        options,
        poses=PosesTable(format="matrix-files", file="pose/*.txt"),
        lens=lambda _: lens,
        depth_camera=depth_camera,
        depth=DepthTable(scale=calibration.depth_scale),
    )


_SCANNET_DOCS = """
ScanNet export | `color/`, `depth/`, `pose/`, `intrinsic/` (or `intrinsics_color.txt`) | a file a frame, -inf =
    none | 1 mm, registered to colour | `intrinsic_color.txt`, `intrinsic_depth.txt`, extrinsics
"""


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
    """What a file says before its frames: where these begin, and how many there are."""

    calibration: SensCalibration
    color_suffix: str
    is_packed: bool
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    first: int
    num_frames: int


def read_sens(path: Path, options: SourceOptions) -> Description:
    """The file, or the only one of a folder, as a description; depth is registered to colour."""
    files = [path] if path.is_file() else sorted(path.glob(f"*{SUFFIX}"))
    if len(files) > 1:
        raise InputError(f"{path}: {len(files)} files *{SUFFIX}", remedy=f"give one of them, such as {files[0]}")
    file, root = files[0], files[0].parent
    sens = _head(file)
    frames = list(_frames(file, sens))
    if not frames:
        raise InputError(f"{file}: expected frames, got none", remedy=_AGAIN)
    has_stamps = len({frame.stamp_ns for frame in frames}) == len(frames)
    views = frames if has_stamps else [replace(frame, stamp_ns=None) for frame in frames]
    missing = sens.num_frames - len(frames)
    color, depth = frames[0].color, frames[0].depth
    assert depth is not None
    lens, depth_camera = sens.calibration.cameras(color, depth, options)
    return described(
        Pairs(path=file, views=views, unpaired=(0, 0)).moved(lambda T: T @ sens.calibration.T_base_color),
        root,
        options,
        poses=PosesTable(format="sens", file=file.name),
        lens=lambda _: lens,
        depth_camera=depth_camera,
        depth=DepthTable(scale=sens.calibration.depth_scale),
        has_stamps=has_stamps,
        num_damaged=missing,
        notes=(f"{file.name}: ends after {len(frames)} of {sens.num_frames} frames",) if missing else (),
    )


def _head(path: Path) -> _Sens:
    with path.open("rb") as stream:
        try:
            version, length = struct.unpack("<IQ", stream.read(12))
            if version != VERSION or length > _MOST_NAME:
                raise InputError(
                    f"{path}: expected a sensor file of version {VERSION}, got {version}",
                    remedy="export it with ScanNet's SensReader",
                )
            stream.read(length)
            *matrices, color, depth, wide, high, depth_wide, depth_high, shift = _HEAD.unpack(stream.read(_HEAD.size))
            (num_frames,) = struct.unpack("<Q", stream.read(8))
        except struct.error:
            raise InputError(f"{path}: ends within its head", remedy=_AGAIN) from None
        first = stream.tell()
    if color not in _COLORS or depth not in (_RAW, _ZLIB):
        raise InputError(
            f"{path}: expected colour as PNG or JPEG (1, 2) and depth as words, plain or zlib (0, 1), got {color} and"
            f" {depth}",
            remedy="export it with ScanNet's SensReader",
        )
    if not (0 < shift < np.inf and 0 < depth_wide * depth_high <= MOST_PIXELS):
        raise InputError(
            f"{path}: expected counts per metre and a size of depth, got {shift} and {depth_wide}x{depth_high}",
            remedy=_AGAIN,
        )
    K_color, T_color, K_depth, T_depth = np.array(matrices, dtype=np.float64).reshape(4, 4, 4)
    return _Sens(
        calibration=SensCalibration(
            color=K_color,
            depth=K_depth,
            T_base_color=rigid(T_color, f"{path}: extrinsic of colour"),
            T_base_depth=rigid(T_depth, f"{path}: extrinsic of depth"),
            depth_scale=1.0 / shift,
            where=str(path),
        ),
        color_suffix=_COLORS[color],
        is_packed=depth == _ZLIB,
        color_size=(wide, high),
        depth_size=(depth_wide, depth_high),
        first=first,
        num_frames=num_frames,
    )


def _frames(path: Path, sens: _Sens) -> Iterator[ListedView]:
    """The frames up to the end of the file."""
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
    """Words of depth as a PNG; nothing where there are fewer, or more."""
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


_SENS_DOCS = """
ScanNet sensor file | `X.sens` of version 4, or a folder that holds one | camera to world of each frame, -inf = none |
    `depthShift` counts per metre (zlib or plain words), registered to colour | of the file, extrinsics
"""

ENTRIES = (
    Layout(
        name="ScanNet export",
        order=2,
        matches=marked(f"{_IMAGES} intrinsic/", f"{_IMAGES} intrinsics_color.txt"),
        read=read_scannet,
        docs=_SCANNET_DOCS,
    ),
    Layout(
        name="ScanNet sensor file",
        order=11,
        matches=marked(f"*{SUFFIX}"),
        read=read_sens,
        suffix=SUFFIX,
        docs=_SENS_DOCS,
    ),
)
