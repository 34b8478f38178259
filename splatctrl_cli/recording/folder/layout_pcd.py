"""Organised PCL point clouds: a ``.pcd`` with a point per pixel, or a folder.

Format: PCL's tutorial "The PCD file format" (v0.7), read by pypcd4 (extra `pcd`). Intrinsics follow from the grid:
the point of column u, row v is on that pixel's ray. VIEWPOINT is the camera's pose; points are in camera (z forward)
or world coordinates, whichever fits.
"""

import struct
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splatctrl_cli.config.fixed import CLOUD_POINTS, CLOUD_RESIDUAL
from splatctrl_cli.errors import InputError, UsageError, refuse_faults, refuse_if
from splatctrl_cli.formats.image_file import MOST_PIXELS
from splatctrl_cli.geometry import invert_transform, project, transform_from, transform_points
from splatctrl_cli.libraries import import_extra
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ImagePart,
    ListedView,
    PosesTable,
)
from splatctrl_cli.recording.folder.layout import CAMERA, Layout, describe, find_marks, list_views, number_key
from splatctrl_cli.recording.folder.poses import stamp_of_text
from splatctrl_cli.recording.log.stored_frame import npy_bytes
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Bool, Float64, Intrinsics, UInt8

SUFFIX = ".pcd"
_UNSET = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # VIEWPOINT that is not set
_MOST_LINES = 32  # of a header
_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_DAMAGE = (ValueError, TypeError, KeyError, RuntimeError, OSError, MemoryError, struct.error)
_AGAIN = "copy the file again"


_library = partial(import_extra, "pypcd4", "pcd", "point clouds (.pcd)")


def read_cloud(path: Path) -> tuple[Float64, UInt8, Float64]:
    """Points (H, W, 3), NaN for none, colour (H, W, 3) RGB, and VIEWPOINT of an organised cloud, as written.

    Raises InputError if damaged or not organised.
    """
    head = _head(path)
    size = (head.height, head.width)
    with _refuse_damage(path):
        columns = _library().PointCloud.from_path(path).pc_data
        points = np.stack([columns[axis].astype(np.float64).reshape(size) for axis in "xyz"], axis=-1)
        packed = columns["rgb" if "rgb" in head.fields else "rgba"].view(np.uint32).reshape(size)
    color = np.stack([packed >> shift & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
    return points, color, _viewpoint(head)


def pinhole_of(points: Float64) -> Intrinsics | None:
    """Fit a pinhole whose pixel (u, v) sees the point (H, W, 3) of row v, column u.

    Least squares over u and v; None with too few points in front, or a focal length that is not positive.
    """
    valid = _is_seen(points)
    v, u = np.nonzero(valid)
    if len(u) < CLOUD_POINTS:
        return None
    rays = points[valid][:, :2] / points[valid][:, 2:]
    lines = [np.linalg.lstsq(np.stack([rays[:, i], np.ones(len(u))], axis=1), (u, v)[i])[0] for i in range(2)]
    (fx, cx), (fy, cy) = (map(float, line) for line in lines)
    if not (fx > 0 and fy > 0):
        return None
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=points.shape[1], height=points.shape[0])


def residual(points: Float64, camera: Intrinsics | None) -> float:
    """95th percentile [px] between points (H, W, 3), projected, and their pixels; inf without a camera."""
    valid = _is_seen(points)
    if camera is None or not valid.any():
        return float("inf")
    v, u = np.nonzero(valid)
    return float(np.percentile(np.linalg.norm(project(camera, points[valid]) - np.stack([u, v], axis=1), axis=1), 95))


def read(path: Path, options: SourceOptions) -> Description:
    """Describe clouds; --depth-scale: metres per unit of points and VIEWPOINT."""
    files = [path] if path.is_file() else sorted(path.glob(f"*{SUFFIX}"), key=lambda p: number_key(p.stem))
    heads, unit = [_head(file) for file in files], options.depth_scale or 1.0
    k, is_world, notes = _fit_lens(files[0], options)
    stamps = [stamp_of_text(file.stem) if "." in file.stem else None for file in files]
    has_stamps = None not in stamps
    views = []
    for number, (file, head) in enumerate(zip(files, heads, strict=True)):
        T, size = _viewpoint(head), (head.width, head.height)
        T[:3, 3] *= unit
        color, depth = partial(_color_file, file), partial(_depth_file, file, k, files[0], is_world=is_world)
        views.append(
            ListedView(
                name=file.stem,
                color=ImagePart(file=file, number=number, size=size, suffix=".png", read_bytes=color),
                depth=ImagePart(file=file, number=number, size=size, suffix=".npy", read_bytes=depth),
                matrix=T,
                stamp_ns=stamps[number] if has_stamps else None,
            )
        )
    if all(tuple(head.viewpoint) == _UNSET for head in heads) and CAMERA not in options.camera_poses:
        refuse_if(
            len(files) > 1,
            f"{path}: no poses: VIEWPOINT is the origin in all {len(files)} clouds",
            remedy="write poses as VIEWPOINT, or give --camera-pose camera=identity where it stands still",
        )
        notes.append("VIEWPOINT is the origin: the camera's own frame is the world")
    others = sorted({name for head in heads for name in head.fields} - {"x", "y", "z", "rgb", "rgba"})
    notes += [f"fields {', '.join(others)} are not used"] if others else []
    lens = CameraTable(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    return describe(
        list_views(path, views, len(views), len(views)),
        path.parent if path.is_file() else path,
        options,
        poses=PosesTable(format="pcd", file=f"*{SUFFIX}" if path.is_dir() else path.name),
        lens=lambda _: lens,
        depth=DepthTable(encoding="float32", scale=unit),
        has_stamps=has_stamps,
        notes=tuple(notes),
    )


def _fit_lens(path: Path, options: SourceOptions) -> tuple[Intrinsics, bool, list[str]]:
    (written, _, T), option = read_cloud(path), options.intrinsics.get(CAMERA)
    fits, (height, width) = [], written.shape[:2]
    for is_world in (False, True):
        points = transform_points(invert_transform(T), written) if is_world else written
        camera = pinhole_of(points)
        if option is not None:
            refuse_if(
                len(option) > 4,
                f"--intrinsics: expected FX,FY,CX,CY for {path.name}, got distortion coefficients",
                error=UsageError,
            )
            fx, fy, cx, cy = option
            camera = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
        fits.append((residual(points, camera), is_world, camera))
    far, is_world, camera = min(fits, key=lambda fit: fit[0])
    if camera is None or far > CLOUD_RESIDUAL:
        raise _unfit(path, far, "of a pinhole camera" if option is None else "that of --intrinsics")
    k = f"fx {camera.fx:.2f}, fy {camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f} px"
    note = f"intrinsics are those of the grid of {path.name}: {k}, within {far:.2g} px"
    return camera, is_world, [] if option is not None else [note]


def _unfit(path: Path, far: float, what: str) -> InputError:
    return InputError(
        f"{path}: the grid is not {what}: 5 % of the points are farther than {far:.3g} px from their pixels, expected"
        f" {CLOUD_RESIDUAL:g}",
        remedy="save clouds in the camera's frame (z forward), or its pose as VIEWPOINT; undistorted, not cropped",
    )


def _head(path: Path) -> Any:
    lines: list[str] = []
    with _refuse_damage(path):
        with path.open("rb") as stream:
            for _ in range(_MOST_LINES):
                line = stream.readline(1 << 12).decode("ascii").strip()
                lines += [line] if line and not line.startswith("#") else []
                if line.startswith("DATA"):
                    break
        head = _library().MetaData.parse_header(lines)
    refuse_if(
        head.height <= 1,
        f"{path}: not organised: {head.width} points in one row",
        remedy="record clouds before any filter, in the rows and columns of the image, NaN where nothing is seen",
    )
    refuse_if(
        not 0 < head.width * head.height <= MOST_PIXELS or head.points != head.width * head.height,
        f"{path}: {head.points} points of {head.width}x{head.height}",
        remedy=_AGAIN,
    )
    refuse_if(
        not np.linalg.norm(head.viewpoint[3:]) > 0.5,
        f"{path}: VIEWPOINT: expected a quaternion, got {head.viewpoint[3:]}",
        remedy=_AGAIN,
    )
    refuse_if(
        not {"rgb", "rgba"} & set(head.fields),
        f"{path}: no colour: expected a field rgb or rgba, got {' '.join(head.fields)}",
        remedy="save clouds with colour (PCL: PointXYZRGB, PointXYZRGBL)",
    )
    return head


def _refuse_damage(path: Path) -> AbstractContextManager[None]:
    def text(error: Exception) -> str:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        return f"{path}: not a PCD that can be read: {reason}"

    return refuse_faults(text, *_DAMAGE, remedy=_AGAIN)


def _viewpoint(head: Any) -> Float64:
    x, y, z, qw, qx, qy, qz = head.viewpoint
    return transform_from((x, y, z), (qx, qy, qz, qw))


def _is_seen(points: Float64) -> Bool:
    return np.asarray(np.isfinite(points).all(axis=2) & (points[..., 2] > 0))


def _color_file(path: Path) -> bytes:
    with suppress(InputError):
        return cv2.imencode(".png", read_cloud(path)[1][..., ::-1], _FAST)[1].tobytes()
    return b""


def _depth_file(path: Path, camera: Intrinsics, first: Path, *, is_world: bool) -> bytes:
    """Depth in the cloud's unit as .npy, 0 = none; empty bytes if unreadable.

    Raises InputError if the camera is not the first cloud's.
    """
    try:
        points, _, T = read_cloud(path)
    except InputError:
        return b""
    points = transform_points(invert_transform(T), points) if is_world else points
    seen = _is_seen(points)
    far = residual(points, camera)
    if seen.any() and far > CLOUD_RESIDUAL:
        raise _unfit(path, far, f"that of {first.name}")
    return npy_bytes(np.where(seen, points[..., 2], 0.0).astype(np.float32))


ENTRIES = (
    Layout(
        name="PCD clouds",
        order=12,
        matches=find_marks(f"*{SUFFIX}"),
        read=read,
        suffix=SUFFIX,
        docs="""
organised point clouds (extra `pcd`) | `X.pcd` of HEIGHT over 1, or a folder of them | `VIEWPOINT` | z in the
    camera; metres, or `--depth-scale` | fitted to the grid, to 0.5 px
""",
    ),
)
