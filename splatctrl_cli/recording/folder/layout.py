"""Shared parts of dataset layouts: lenses, image sizes, numbers, descriptions."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if, require
from splatctrl_cli.formats.image_file import decode_file, image_head
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    Description,
    ImageFile,
    ImagePart,
    ListedView,
    StampsTable,
    check_camera,
)
from splatctrl_cli.recording.folder.poses import read_numbers
from splatctrl_cli.recording.log.survey import pair_images
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64

CAMERA = "camera"  # the name of a layout's only lens
_WHOLE = "check that the folder is whole"
_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm"})


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A dataset layout, in its module's ``ENTRIES``.

    order: the lowest that matches is used. suffix: of a file that is a dataset by itself. docs: rows of
    docs/input.md, cells between bars, an empty line between rows: layout, marks, poses, depth, intrinsics.
    """

    name: str
    order: int
    matches: Callable[[Path], bool]
    read: Callable[[Path, SourceOptions], Description]
    suffix: str = ""
    docs: str = ""


def find_marks(*alternatives: str) -> Callable[[Path], bool]:
    """Make a test of folders: all marks of one alternative are there ("X/": a folder)."""

    def has(folder: Path, mark: str) -> bool:
        return any(path.is_dir() if mark.endswith("/") else path.is_file() for path in folder.glob(mark))

    return lambda folder: any(all(has(folder, mark) for mark in marks.split()) for marks in alternatives)


def ask_description(name: str, *examples: str) -> Callable[[Path, SourceOptions], Description]:
    """Make a reader that refuses a folder and asks for a description."""

    def refuse(folder: Path, _: SourceOptions) -> Description:
        raise InputError(
            f"{folder}: laid out as {name}, whose lens and poses a description names",
            remedy=f"write {' or '.join(f'{one}.toml (`splatctrl help {one}` prints it)' for one in examples)}, enter"
            f" your numbers, and give it with --root {folder}",
        )

    return refuse


def add_lens(lenses: list[CameraTable], table: CameraTable, where: str) -> CameraTable:
    """The known camera equal to `table`, else `table`, added as ``camera``, ``camera-1``, ...

    Raises InputError if it is impossible.
    """
    for known in lenses:
        if asdict(replace(known, name=table.name)) == asdict(table):
            return known
    check_camera(table, where)
    lenses.append(replace(table, name=f"{table.name}-{len(lenses)}" if lenses else table.name))
    return lenses[-1]


def list_views(path: Path, views: Sequence[ListedView], num_colors: int, num_depths: int) -> Description:
    """Describe views of `num_colors` and `num_depths` files. Raises InputError without a view."""
    refuse_if(not views, f"{path}: no colour image has a depth image", remedy=_WHOLE)
    unpaired = (num_colors - len(views), num_depths - len(views))
    return Description(path=path, root=path, poses=None, listed=tuple(views), unpaired=unpaired)


def move_poses(pairs: Description, change: Callable[[Float64], Float64]) -> Description:
    views = (v if v.matrix is None else replace(v, matrix=change(v.matrix)) for v in pairs.listed)
    return replace(pairs, listed=tuple(views))


def pair_stamps(
    path: Path,
    colors: Sequence[tuple[int, Path]],
    depths: Sequence[tuple[int, Path]],
    pose_at: Callable[[int], Float64 | None],
    options: SourceOptions,
) -> Description:
    """Pair files by stamp [ns] within the tolerance; the pose is at colour's stamp."""
    views = [
        ListedView(
            name=f"{colors[i][0] / 1e9:.6f}",
            color=colors[i][1],
            depth=depths[j][1],
            matrix=pose_at(colors[i][0]),
            stamp_ns=colors[i][0],
        )
        for i, j in pair_images(
            [stamp for stamp, _ in colors], [stamp for stamp, _ in depths], round(options.pairing_tolerance_s * 1e9)
        ).tolist()
    ]
    return list_views(path, views, len(colors), len(depths))


def describe(
    pairs: Description,
    root: Path,
    options: SourceOptions,
    *,
    lens: Callable[[ImageFile], CameraTable] | None = None,
    has_stamps: bool = False,
    **fields: Any,
) -> Description:
    """Complete listed views with the lens of --intrinsics, else `lens` of the first image.

    Without `lens`, each view has its own. Raises InputError if a camera is impossible.
    """
    first = pairs.listed[0]
    camera = first.camera if lens is None else lens_option(options, first.color) or lens(first.color)
    description = replace(pairs, root=root, camera=camera, stamps=StampsTable(names=has_stamps), **fields)
    for table in (camera, description.depth_camera):
        if table is not None:
            check_camera(table, str(description.path))
    return description


def lens_option(options: SourceOptions, image: ImageFile) -> CameraTable | None:
    """The lens of --intrinsics for ``camera``, in the size of `image`; None if not given."""
    values = options.intrinsics.get(CAMERA)
    return None if values is None else pinhole(values[:4], image, values[4:])


def pinhole(values: Sequence[float], image: ImageFile, distortion: Sequence[float] = ()) -> CameraTable:
    """A lens of fx, fy, cx, cy [px] and an image's size."""
    width, height = image_size(image)
    fx, fy, cx, cy = values
    return CameraTable(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=list(distortion))


def read_K(path: Path) -> tuple[float, float, float, float]:
    """Intrinsics fx, fy, cx, cy of a text file's 3x3 matrix."""
    values = read_numbers(path)
    refuse_if(
        len(values) != 9,
        f"{path}: expected a 3x3 matrix, got {len(values)} numbers",
        remedy="correct the file, or give --intrinsics camera=FX,FY,CX,CY",
    )
    return values[0], values[4], values[2], values[5]


def own_depth_camera(color: CameraTable, depth: CameraTable, T_color_depth: Float64) -> CameraTable | None:
    """The depth camera posed in the colour camera; None if they are the same."""
    is_same = depth == color and np.abs(T_color_depth - np.eye(4)).max() <= 1e-6
    return None if is_same else replace(depth, depth_to_color=T_color_depth.tolist())


def image_size(path: ImageFile) -> tuple[int, int]:
    """Columns and rows. Raises InputError if it is no image."""
    if isinstance(path, ImagePart):
        return path.size
    with refuse_faults(lambda error: f"{path}: {error.strerror}", OSError, remedy=_WHOLE):
        data = path.read_bytes()
    if (head := image_head(data)) is not None:
        return head.width, head.height
    height, width, *_ = require(
        decode_file(data, color=False), f"{path}: not an image that can be read", remedy=_WHOLE
    ).shape
    return int(width), int(height)


def images_of(folder: Path) -> dict[str, Path]:
    """Images by stem, sorted by numbers."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in _IMAGES]
    return {path.stem: path for path in sorted(files, key=lambda p: number_key(p.stem))}


def number_key(name: str) -> tuple[list[int], str]:
    """A key that sorts 2 before 10."""
    return [int(number) for number in re.findall(r"\d+", name)], name


def pose_or_none(matrix: Float64) -> Float64 | None:
    """The matrix, None if not finite (lost)."""
    return matrix if np.isfinite(matrix).all() else None


def read_json(path: Path) -> Any:
    """Read JSON. Raises InputError if unreadable."""
    with refuse_faults(f"{path}: not readable JSON", ValueError, OSError, remedy=_WHOLE):
        return json.loads(path.read_text(encoding="utf-8"))
