"""A folder of colour and depth images with a TOML description, as records."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.io.folder_description import (
    CameraTable,
    Description,
    FramesTable,
    check_camera,
    read_description,
)
from splatctrl_cli.io.masks import human_mask
from splatctrl_cli.io.messages import decode_file, metres, num_invalid
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.output import sha256
from splatctrl_cli.io.poses import (
    READERS,
    read_matrix_blocks,
    read_matrix_file,
    read_nerfstudio,
    world_camera,
)
from splatctrl_cli.io.registration import DepthToColor, Undistortion
from splatctrl_cli.io.shot import Shot, check_depth, is_kept
from splatctrl_cli.records import Float32, Float64, JointState, LossReport, Record, RgbdFrame, UInt8

HOLDOUT = "holdout"
_NOT_FOR_FOLDERS = ("world_frame", "camera_topics", "camera_poses", "human_topics", "joint_topic")
_SECOND = 1_000_000_000
_POSE_TOLERANCE_S = 0.02  # of poses that are matched by stamp


@dataclass(frozen=True, kw_only=True)
class _View:
    """One pair of files, and a mask where there is one; name is the text that `*` stood for."""

    name: str
    color: Path
    depth: Path
    human: Path | None
    T_world_camera: Float64
    stamp_ns: int
    camera: str


class ImageFolderSource:
    """Records of an image folder; no joint states."""

    joint_names: tuple[str, ...] = ()
    world_frame = "world"

    def __init__(self, path: Path, options: SourceOptions, description: Description | None = None) -> None:
        options.refuse(_NOT_FOR_FOLDERS, "an image folder", path)
        self.name = path.name
        self._description = _completed(description or read_description(path, options.root))
        self._scale = self._description.depth.scale if options.depth_scale is None else options.depth_scale
        camera = self._description.camera
        assert camera is not None
        self._intrinsics = camera.intrinsics
        self._undistortion = (
            Undistortion(self._intrinsics, camera.distortion_model, np.array(camera.distortion))
            if np.any(camera.distortion)
            else None
        )
        depth_camera = self._description.depth_camera
        self._registration = (
            DepthToColor(
                depth_intrinsics=depth_camera.intrinsics,
                color_intrinsics=self._intrinsics,
                T_color_depth=self._description.T_color_depth,
            )
            if depth_camera is not None
            else None
        )
        self._loss = LossReport()
        self._damaged: list[str] = []
        self._num_invalid = 0
        self._views = _views(self._description, camera.name, options, self._loss)
        names = tuple(sorted({view.camera for view in self._views}))
        if options.cameras is not None:
            for name in options.cameras:
                if name not in names:
                    raise InputError(f"{path}: no camera {name!r}", remedy=f"use one of: {', '.join(names)}")
            self._views = [view for view in self._views if view.camera in options.cameras]
        self.cameras = names if options.cameras is None else options.cameras

    @property
    def has_clock(self) -> bool:
        """Whether the description says when the images were taken."""
        stamps = self._description.stamps
        return stamps.rate is not None or stamps.names

    @property
    def loss(self) -> LossReport:
        """Unpaired and unposed images, and those that did not decode while `records` was read."""
        loss = self._loss
        return replace(
            loss,
            damaged=loss.damaged + len(self._damaged),
            invalid_depth=self._num_invalid,
            notes=[*loss.notes, *self._damaged],
        )

    def records(self) -> Iterator[Record]:
        """Frames by stamp."""
        for item in self.shots():
            yield item.frame if isinstance(item, Shot) else item

    def shots(self) -> Iterator[Shot | JointState]:
        """Shots by stamp."""
        self._damaged, self._num_invalid = [], 0
        checked: set[str] = set()
        for view in self._views:
            shot = self._shot(view)
            if shot is None:
                continue
            if view.camera not in checked and check_depth(shot.frame.depth, str(view.depth), self._scale):
                checked.add(view.camera)
            yield shot

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Of every view."""
        return ((view.stamp_ns, view.camera, view.T_world_camera) for view in self._views)

    def count_views(self) -> dict[str, int]:
        """Views by camera."""
        return {name: sum(view.camera == name for view in self._views) for name in self.cameras}

    def digests(self) -> dict[str, str]:
        """sha256 of the description, the pose file and the images, by path below the root."""
        return dict(self._digests)

    @cached_property
    def _digests(self) -> dict[str, str]:
        description = self._description
        files = [path for view in self._views for path in (view.color, view.depth, view.human) if path is not None]
        files.extend(path for _, path in _glob(description.root, description.poses.file))
        named = {str(path.relative_to(description.root)): path for path in files}
        return {
            name: sha256(path) for name, path in [(description.path.name, description.path), *sorted(named.items())]
        }

    def _shot(self, view: _View) -> Shot | None:
        color_bytes = view.color.read_bytes()
        bgr = decode_file(color_bytes, color=True)
        depth = self._depth(view.depth)
        if bgr is None or depth is None:
            broken = view.color if bgr is None else view.depth
            self._damaged.append(f"{broken}: not an image that can be read")
            return None
        _check_size(view.color, bgr, self._description.camera)
        color = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        if self._registration is not None:
            _check_size(view.depth, depth, self._description.depth_camera)
            depth = self._registration.warp(depth)
        else:
            _check_size(view.depth, depth, self._description.camera)
        if self._undistortion is not None:
            color = self._undistortion.color(np.asarray(color))
            depth = self._undistortion.depth(depth) if self._registration is None else depth
        human = None if view.human is None else self._human(view.human)
        is_counts = self._registration is None and self._description.depth.encoding != "float32"
        is_plain = self._undistortion is None and is_kept(color_bytes)
        return Shot(
            frame=RgbdFrame(
                stamp_ns=view.stamp_ns,
                camera=view.camera,
                color=np.asarray(color, dtype=np.uint8),
                depth=depth,
                intrinsics=self._intrinsics,
                T_world_camera=view.T_world_camera,
                human=human,
            ),
            color_file=color_bytes if is_plain else None,
            depth_unit=self._scale if is_counts else None,
            origin=f"{view.color.name} {view.depth.name}",
        )

    def _human(self, path: Path) -> UInt8 | None:
        pixels = decode_file(path.read_bytes(), color=False)
        if pixels is None:
            self._damaged.append(f"{path}: not an image that can be read")
            return None
        human = human_mask(pixels, self._intrinsics, str(path))
        return human if self._undistortion is None else self._undistortion.labels(human)

    def _depth(self, path: Path) -> Float32 | None:
        encoding = self._description.depth.encoding
        if encoding == "float32":
            pixels = _float_pixels(path)
            if pixels is None:
                return None
            self._num_invalid += num_invalid(pixels)
            depth = pixels * np.float32(self._scale)
            return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
        counts = decode_file(path.read_bytes(), color=False)
        if counts is None:
            return None
        if counts.dtype != np.uint16 or counts.ndim != 2:
            raise InputError(
                f"{path}: expected a 16-bit grey image, got {counts.dtype} with {counts.ndim} axes",
                remedy="see docs/input.md",
            )
        if encoding == "uint16-rotated3":
            counts = (counts >> 3) | (counts << 13)
        return metres(counts, self._scale)


def _float_pixels(path: Path) -> NDArray[np.float32] | None:
    if path.suffix == ".npy":
        try:
            return np.asarray(np.load(path, allow_pickle=False), dtype=np.float32)
        except (ValueError, EOFError):
            return None
    pixels = decode_file(path.read_bytes(), color=False)
    return None if pixels is None else pixels.astype(np.float32)


def _check_size(path: Path, pixels: NDArray[Any], camera: CameraTable | None) -> None:
    assert camera is not None
    if pixels.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{path}: expected {camera.width}x{camera.height} as described, got {pixels.shape[1]}x{pixels.shape[0]}",
            remedy="correct the size, or describe the depth camera in [depth_camera]",
        )


def _completed(description: Description) -> Description:
    """With the camera and globs of a transforms.json where the description leaves them to it."""
    if description.poses.format != "nerfstudio":
        return description
    content, _ = read_nerfstudio(description.root / description.poses.file)
    camera, frames = description.camera, description.frames
    try:
        if camera is None:
            camera = CameraTable(
                width=int(content["w"]),
                height=int(content["h"]),
                fx=float(content["fl_x"]),
                fy=float(content["fl_y"]),
                cx=float(content["cx"]),
                cy=float(content["cy"]),
                pixel_center=0.5,  # nerfstudio's convention
                distortion=[float(content.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2")],
            )
        if frames is None:
            first = content["frames"][0]
            color, depth = Path(first["file_path"]), Path(first["depth_file_path"])
            frames = FramesTable(
                color=str(color.parent / f"*{color.suffix}"), depth=str(depth.parent / f"*{depth.suffix}")
            )
        check_camera(camera, str(description.root / description.poses.file))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f"{description.root / description.poses.file}: {error} is missing",
            remedy="give [camera] and [frames] in the description",
        ) from None
    return replace(description, camera=camera, frames=frames)


def _views(description: Description, camera: str, options: SourceOptions, loss: LossReport) -> list[_View]:
    frames = description.frames
    assert frames is not None
    colors = dict(_glob(description.root, frames.color))
    depths = dict(_glob(description.root, frames.depth))
    for pattern, found in ((frames.color, colors), (frames.depth, depths)):
        if not found:
            raise InputError(
                f"{description.path}: no file matches {description.root / pattern}", remedy="correct [frames] or root"
            )
    masks = _masks(description, list(colors), loss)
    names = [name for name in colors if name in depths]
    if not names:
        raise InputError(
            f"{description.path}: no colour file has a depth file of the same name"
            f" ({next(iter(colors))!r}, {next(iter(depths))!r}, ...)",
            remedy="the * of [frames] color and depth must stand for the same text",
        )
    loss.unpaired_color, loss.unpaired_depth = len(colors) - len(names), len(depths) - len(names)
    poses = _poses(description, {name: colors[name] for name in names})
    held = _holdout(description, names, options)
    views = []
    for position, name in enumerate(names):
        if name in poses:
            where = f"{description.poses.file}: pose of {name}"
            views.append(
                _View(
                    name=name,
                    color=colors[name],
                    depth=depths[name],
                    human=masks.get(name),
                    T_world_camera=world_camera(
                        poses[name], description.poses.convention, description.poses.axes, where
                    ),
                    stamp_ns=_stamp_ns(description, name, position),
                    camera=HOLDOUT if name in held else camera,
                )
            )
    loss.without_pose = len(names) - len(views)
    if not views:
        raise InputError(
            f"{description.path}: {description.poses.file} has no pose for any image ({names[0]}, ...)",
            remedy="check [poses] format and the numbers in the file names",
        )
    if held and all(view.camera == HOLDOUT for view in views):
        remedy = "leave some to train with"
        if options.holdout is not None:
            raise UsageError(f"--holdout: all {len(views)} views are held out", remedy=remedy)
        raise InputError(f"{description.path}: [split] holds all {len(views)} views out", remedy=remedy)
    return sorted(views, key=lambda view: (view.stamp_ns, view.name))


def _masks(description: Description, names: list[str], loss: LossReport) -> dict[str, Path]:
    """Mask files by view name; views without one are noted in `loss`."""
    assert description.frames is not None
    pattern = description.frames.human_mask
    if not pattern:
        return {}
    masks = dict(_glob(description.root, pattern))
    if not any(name in masks for name in names):
        raise InputError(
            f"{description.path}: no file of {description.root / pattern} is named like a colour image",
            remedy="the * of [frames] human_mask and color must stand for the same text",
        )
    num_without = sum(name not in masks for name in names)
    if num_without:
        loss.notes.append(f"{num_without} of {len(names)} colour images have no mask")
    return masks


def _glob(root: Path, pattern: str) -> list[tuple[str, Path]]:
    """Files by the text that the pattern's `*` stands for, sorted; a pattern without `*` is one file, by no text."""
    if "*" not in pattern:
        return [("", root / pattern)] if (root / pattern).is_file() else []
    expression = re.compile(".*".join(re.escape(part) for part in pattern.split("*")).replace(".*", "(.*)", 1))
    found = []
    for path in sorted(root.glob(pattern)):
        match = expression.fullmatch(path.relative_to(root).as_posix())
        if match is not None:
            found.append((match[1], path))
    return found


def _poses(description: Description, colors: dict[str, Path]) -> dict[str, Float64]:
    """Matrices as written, by view name."""
    table, root = description.poses, description.root
    if table.format == "matrix-files":
        files = dict(_glob(root, table.file))
        if "" in files:  # a camera that does not move
            return dict.fromkeys(colors, read_matrix_file(files[""]))
        return {name: read_matrix_file(files[name]) for name in colors if name in files}
    if table.format == "matrix-blocks":
        by_key = read_matrix_blocks(root / table.file, table.heading)
    else:
        by_key = READERS[table.format](root / table.file)
    if table.format == "tum":
        return _poses_by_stamp(by_key, list(colors))
    if table.format == "nerfstudio":
        keys = {name: path.relative_to(root).as_posix() for name, path in colors.items()}
        by_key = {key.removeprefix("./"): pose for key, pose in by_key.items()}
    else:
        keys = {name: str(_number(name)) for name in colors}
    return {name: by_key[key] for name, key in keys.items() if key in by_key}


def _poses_by_stamp(poses: dict[str, Float64], names: list[str]) -> dict[str, Float64]:
    """The pose nearest in time to each view, whose name is its stamp [s]."""
    stamps = np.array([float(key) for key in poses])
    matrices = list(poses.values())
    found = {}
    for name in names:
        seconds = _seconds(name)
        if seconds is not None and len(stamps):
            nearest = int(np.argmin(np.abs(stamps - seconds)))
            if abs(stamps[nearest] - seconds) <= _POSE_TOLERANCE_S:
                found[name] = matrices[nearest]
    return found


def _holdout(description: Description, names: list[str], options: SourceOptions) -> set[str]:
    """Names held out; an entry is a name, else a position in the sorted list of pairs."""
    entries = description.split.holdout if options.holdout is None else options.holdout
    held = set()
    for entry in entries:
        if str(entry) in names:
            held.add(str(entry))
        elif str(entry).isdigit() and int(entry) < len(names):
            held.add(names[int(entry)])
        else:
            raise InputError(
                f"{description.path}: holdout {entry!r}: no such frame",
                remedy=f"use a name ({names[0]} to {names[-1]}) or a position (0 to {len(names) - 1})",
            )
    return held


def _stamp_ns(description: Description, name: str, position: int) -> int:
    """From the file name, the frame number and the rate, or (no clock) one second a frame."""
    stamps = description.stamps
    if stamps.names:
        seconds = _seconds(name)
        if seconds is None:
            raise InputError(
                f"{description.path}: stamps.names: expected seconds, got {name!r}", remedy="see docs/input.md"
            )
        return round(seconds * _SECOND)
    if stamps.rate is not None:
        return round(_number(name) * _SECOND / stamps.rate)
    return position * _SECOND


def _number(name: str) -> int:
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else -1


def _seconds(name: str) -> float | None:
    try:
        return float(name)
    except ValueError:
        return None
