"""Image folders with a TOML description, of one or several cameras, as records.

Dataset layouts are known by their own files, without a description.
"""

import heapq
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import UNIT_BASELINE
from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.files.output import sha256
from splatctrl_cli.files.summary import names_in
from splatctrl_cli.formats.arrays import DAMAGE, npy_of
from splatctrl_cli.formats.image_file import PNG, decode_file, read_pfm
from splatctrl_cli.libraries import entries_of
from splatctrl_cli.recording.capture.capture_writer import check_not_partial
from splatctrl_cli.recording.container.log_formats import SUFFIXES, is_bag_folder
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    Description,
    ImageFile,
    read_description,
    read_rig,
    whole_file,
)
from splatctrl_cli.recording.folder.folder_views import UNITS, View, find_files, length_unit, views_of
from splatctrl_cli.recording.folder.idr import idr_scans
from splatctrl_cli.recording.folder.layout import Layout, images_of
from splatctrl_cli.recording.folder.layout_nerfstudio import fill_transforms
from splatctrl_cli.recording.log.messages import convert_floats, metres, num_invalid
from splatctrl_cli.recording.log.registration import Lens, correct_lens
from splatctrl_cli.recording.log.stored_frame import (
    FrameSource,
    StoredFrame,
    check_depth,
    human_mask,
    is_kept,
)
from splatctrl_cli.recording.source_options import SourceOptions, refuse_unknown_cameras
from splatctrl_cli.records import Bool, Float32, Float64, LossReport, UInt8

_NOT_FOR_FOLDERS = (
    *("world_frame", "camera_topics", "camera_pose_topics", "human_topics"),
    *("joint_topic", "stamps"),
)


class ImageFolderSource(FrameSource):
    """Frames of an image folder, without joint states.

    Descriptions of several cameras differ only in files, lens and poses.
    """

    world_frame = "world"

    def __init__(self, path: Path, options: SourceOptions, *descriptions: Description) -> None:
        options.refuse(_NOT_FOR_FOLDERS, "an image folder", path)
        self.name = path.name
        self._descriptions = tuple(map(fill_transforms, descriptions))
        self._description = self._descriptions[0]
        self.has_clock = self._description.stamps.rate is not None or self._description.stamps.names
        self._loss = LossReport()
        self._damaged: list[str] = []
        self._num_invalid = 0
        of_each = [views_of(description, options, self._loss) for description in self._descriptions]
        self._views = list(heapq.merge(*of_each, key=lambda view: view.stamp_ns))
        self._lenses: dict[str, Lens] = {}
        self.guess = "" if self.has_clock else self._convert_to_metres()
        """Unit that lengths seem to have, in words; empty if they may be metres."""
        refuse_unknown_cameras(
            path, (*options.camera_poses, *options.intrinsics), sorted({view.lens.name for view in self._views})
        )
        names = sorted({view.camera for view in self._views})
        self.cameras = tuple(names) if options.cameras is None else options.cameras
        refuse_unknown_cameras(path, self.cameras, names)
        self._views = [view for view in self._views if view.camera in self.cameras]
        if all(view.depth is None for view in self._views):  # every depth is 0
            self.depth_fault = InputError(
                f"{self._description.path}: depth is missing: none of its {len(self._views)} views has any",
                remedy=f"{self._description.supply}; info, score and reconstruct --points CLOUD.ply work without"
                " depth",
            )

    @property
    def loss(self) -> LossReport:
        loss = self._loss
        return replace(
            loss,
            damaged=loss.damaged + len(self._damaged),
            invalid_depth=self._num_invalid,
            notes=[*loss.notes, *self._damaged],
        )

    def _convert_to_metres(self) -> str:
        """Convert lengths in millimetres or centimetres; return a note, or ""."""
        places = np.ptp([view.T_world_camera[:3, 3] for view in self._views], axis=0)
        apart = float(np.linalg.norm(places))  # the diagonal of their box, in the unit of the poses
        for view in self._views if apart > UNIT_BASELINE / max(UNITS) else ():
            depth = self._depth(view, self._lens(view))
            if depth is None or not (depth > 0).any():
                continue
            median = float(np.median(depth[depth > 0]))
            unit = length_unit(median, apart)
            if unit == 1.0:
                return ""
            self._views = [view.convert(unit) for view in self._views]
            words = (
                f"lengths are taken as {UNITS[unit]}: the median depth is {median:.4g}, and the cameras are up to"
                f" {apart:.4g} apart"
            )
            self._loss.notes.append(words)
            return words
        return ""

    def _frames(self) -> Iterator[StoredFrame]:
        self._damaged, self._num_invalid = [], 0
        checked: set[str] = set()
        for view in self._views:
            stored = self._stored_frame(view)
            if stored is None:
                continue
            is_next = view.depth is not None and view.camera not in checked
            if is_next and check_depth(stored.depth, str(view.depth), view.depth_scale):
                checked.add(view.camera)
            yield stored

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        return ((view.stamp_ns, view.camera, view.T_world_camera) for view in self._views)

    @cached_property
    def _digests(self) -> dict[str, str]:
        by_name: dict[str, Path] = {}
        for description in self._descriptions:
            lens = None if len(self._descriptions) == 1 else description.camera
            views = [view for view in self._views if lens is None or view.lens == lens]
            of_views = ((view.color, view.depth, view.human, view.valid) for view in views)
            files = [whole_file(path) for paths in of_views for path in paths if path is not None]
            if description.poses is not None:
                files.extend(path for _, path in find_files(description.root, description.poses.file))
            named = {str(path.relative_to(description.root)): path.absolute() for path in files}
            by_name |= {
                **({description.path.name: description.path} if description.path.is_file() else {}),
                **dict(sorted(named.items())),
            }
        return {name: sha256(path) for name, path in by_name.items()}

    def _stored_frame(self, view: View) -> StoredFrame | None:
        color_bytes = view.color.read_bytes()
        color = decode_file(color_bytes, color=True)
        lens = self._lens(view)
        depth = self._depth(view, lens)
        if color is None or depth is None:
            broken = view.color if color is None else view.depth
            self._damaged.append(f"{broken}: not an image that can be read")
            return None
        _check_size(view.color, color, view.lens)
        color = lens.remap(np.asarray(color), cv2.INTER_LINEAR)
        human = None if view.human is None else self._human(view.human, lens)
        valid = self._valid(view, lens)
        depth = depth if valid is None else np.where(valid, depth, np.float32(0))
        is_counts = lens.depth_lens is None and not (
            view.depth is None or self._description.depth.encoding == "float32" or view.depth.suffix == ".npy"
        )
        is_plain = lens.maps is None
        return StoredFrame(
            stamp_ns=view.stamp_ns,
            camera=view.camera,
            intrinsics=lens.intrinsics,
            T_world_camera=view.T_world_camera,
            read_color=lambda: np.asarray(color, dtype=np.uint8),
            read_depth=lambda: np.asarray(depth, dtype=np.float32),
            human=human,
            valid=valid,
            color_file=color_bytes if is_plain and is_kept(color_bytes) else None,
            depth_unit=view.depth_scale if is_counts else None,
            depth_file=self._depth_file(view) if is_counts and is_plain and valid is None else None,
            origin=f"{view.color.name} {view.depth.name}" if view.depth else view.color.name,
        )

    def _depth_file(self, view: View) -> bytes | None:
        table = self._description.depth
        if (
            view.depth is None
            or table.encoding != "uint16"
            or table.invalid > 0
            or self._description.is_depth_resized
        ):
            return None
        data = view.depth.read_bytes()
        return data if is_kept(data, PNG) else None

    def _lens(self, view: View) -> Lens:
        table, depth_camera = view.lens, self._description.depth_camera
        if table.name not in self._lenses:
            lens = _corrected(table)
            if depth_camera is not None:
                lens = replace(
                    lens, depth_lens=_corrected(depth_camera), T_color_depth=self._description.T_color_depth
                )
            self._lenses[table.name] = lens
        return self._lenses[table.name]

    def _valid(self, view: View, lens: Lens) -> Bool | None:
        seen = lens.valid
        if view.valid is None:
            return seen
        mask = self._human(view.valid, lens)
        if mask is None:
            return np.zeros((lens.intrinsics.height, lens.intrinsics.width), np.bool_)
        return np.asarray((mask > 0) if seen is None else (mask > 0) & seen)

    def _human(self, path: Path, lens: Lens) -> UInt8 | None:
        pixels = decode_file(path.read_bytes(), color=False)
        if pixels is None:
            self._damaged.append(f"{path}: not an image that can be read")
            return None
        return lens.remap(human_mask(pixels, lens.intrinsics, str(path)))

    def _depth(self, view: View, lens: Lens) -> Float32 | None:
        """(H, W) [m] at colour's pixels, 0 = no return; None if unreadable."""
        if view.depth is None:
            return np.zeros((view.lens.height, view.lens.width), np.float32)
        depth = self._recorded_depth(view.depth, view.depth_scale)
        if depth is None:
            return None
        if self._description.is_depth_resized:
            depth = np.asarray(
                cv2.resize(depth, (view.lens.width, view.lens.height), interpolation=cv2.INTER_NEAREST), np.float32
            )
        _check_size(view.depth, depth, self._description.depth_camera or view.lens)
        return lens.depth(depth)

    def _recorded_depth(self, path: ImageFile, scale: float) -> Float32 | None:
        table = self._description.depth
        if table.encoding == "float32" or path.suffix == ".npy":  # which always has floats (nerfstudio)
            pixels = _float_pixels(path)
            if pixels is None:
                return None
            self._num_invalid += num_invalid(pixels)
            return convert_floats(pixels, scale)
        counts = decode_file(path.read_bytes(), color=False)
        if counts is None:
            return None
        refuse_if(
            counts.dtype != np.uint16 or counts.ndim != 2,
            f"{path}: expected a 16-bit grey image, got {counts.dtype} with {counts.ndim} axes",
            remedy="see splatctrl help input",
        )
        if table.encoding == "uint16-rotated3":
            counts = (counts >> 3) | (counts << 13)
        counts = np.where(counts == table.invalid, np.uint16(0), counts)
        self._num_invalid += num_invalid(counts)
        return metres(counts, scale)


def _corrected(camera: CameraTable) -> Lens:
    return correct_lens(camera.intrinsics, camera.distortion_model, np.array(camera.distortion, np.float64))


def _float_pixels(path: ImageFile) -> NDArray[np.float32] | None:
    if path.suffix == ".pfm" and isinstance(path, Path):
        with suppress(InputError):
            return read_pfm(path)
        return None
    if path.suffix == ".npy":
        with suppress(*DAMAGE):
            return np.asarray(npy_of(path.read_bytes()), dtype=np.float32)
        return None
    pixels = decode_file(path.read_bytes(), color=False)
    return None if pixels is None else pixels.astype(np.float32)


def _check_size(path: ImageFile, pixels: NDArray[Any], camera: CameraTable) -> None:
    refuse_if(
        pixels.shape[:2] != (camera.height, camera.width),
        f"{path}: expected {camera.width}x{camera.height} as described, got {pixels.shape[1]}x{pixels.shape[0]}",
        remedy="correct the size, or describe the depth camera in [depth_camera]",
    )


def open_image_folder(path: Path, options: SourceOptions) -> ImageFolderSource:
    rig = {part.camera.name: part for part in read_rig(path, options.root) if part.camera is not None}
    if not rig:
        options.refuse(("intrinsics",), "a folder whose description has [camera]", path)
        return ImageFolderSource(path, options, read_description(path, options.root))
    options.refuse(("holdout", "intrinsics", "camera_pose_topics"), "a description with several cameras", path)
    refuse_unknown_cameras(path, (*(options.cameras or ()), *options.camera_poses), rig)
    names = options.cameras or tuple(rig)
    return ImageFolderSource(
        path,
        replace(
            options,
            cameras=names,
            camera_poses={name: pose for name, pose in options.camera_poses.items() if name in names},
        ),
        *(rig[name] for name in names),
    )


_COLORS = ("images", "image", "rgb", "color")  # folders of images in a folder without depth
_MOST_LOOKED_AT, _MOST_NAMED = 200, 8  # entries of an unknown folder

LAYOUTS = entries_of(__package__, Layout)


def layout_of(path: Path) -> Layout | None:
    if path.is_file():
        return next((layout for layout in LAYOUTS if layout.suffix == path.suffix.lower() != ""), None)
    return next((layout for layout in LAYOUTS if layout.matches(path)), None)


def has_views(path: Path) -> bool:
    """True for a folder that is no ROS 2 bag, and for a layout's file."""
    return layout_of(path) is not None if path.is_file() else path.is_dir() and not is_bag_folder(path)


def open_layout(folder: Path, options: SourceOptions) -> ImageFolderSource:
    """Open a dataset's folder. Raises InputError for an unknown layout."""
    check_not_partial(folder)
    layout = layout_of(folder)
    refuse_if(
        layout is None and ((folder / "Rectified").is_dir() or idr_scans(folder)),
        f"{folder}: a DTU data set, which only reconstruct and score read",
        remedy='give it as --dtu (in a suite dtu = "{recording}")',
    )
    if layout is None:
        names = ", ".join(known.name for known in LAYOUTS)
        raise unknown_folder(
            folder,
            f"a folder that is neither a capture nor a ROS 2 bag, nor laid out as {names}",
            "give the capture, the bag, one scene of the dataset, or a .toml for images (splatctrl help input)",
        )
    options.refuse(("root",), f"a folder laid out as {layout.name}", folder)
    return ImageFolderSource(folder, options, layout.read(folder, options))


def unknown_folder(folder: Path, what: str, remedy: str) -> InputError:
    """An error that names readable parts, else missing depth."""
    inside = _readable_in(folder)
    if not inside and (bare := _bare_images(folder)):
        return InputError(
            f"{folder}: {bare}",
            remedy="describe colour, depth, lens and poses in a .toml (splatctrl help input); info, score and"
            " reconstruct --points CLOUD.ply work without depth, but not without poses: a transforms.json"
            " (ns-process-data writes it)",
        )
    return InputError(f"{folder}: {what}", remedy=f"give one that is in it: {inside}" if inside else remedy)


def _bare_images(folder: Path) -> str:
    num = max(len(images_of(place)) for place in (folder, *(folder / name for name in _COLORS)) if place.is_dir())
    is_colmap = any((folder / place).exists() for place in ("sparse", "images.bin", "images.txt"))
    return f"depth is missing: images{' of a COLMAP model' if is_colmap else ''} alone ({num})" if num else ""


def _readable_in(folder: Path) -> str:
    parts = []
    for name in names_in(folder)[:_MOST_LOOKED_AT]:
        path = folder / name
        if path.is_file() and (path.suffix in SUFFIXES or layout_of(path) is not None):
            parts.append(path.name)
        elif path.is_dir() and (layout := layout_of(path)) is not None:
            parts.append(f"{path.name} ({layout.name})")
        elif path.is_dir() and (path / "metadata.yaml").is_file():
            parts.append(f"{path.name} (ROS 2 bag)")
        elif path.is_dir() and (path / "capture.json").is_file():
            parts.append(f"{path.name} (capture)")
    return ", ".join(parts[:_MOST_NAMED]) + (
        f" and {len(parts) - _MOST_NAMED} more" if len(parts) > _MOST_NAMED else ""
    )
