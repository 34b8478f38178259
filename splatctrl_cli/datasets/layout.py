"""What the readers of dataset layouts share: lenses by name, sizes of images, numbers in names, a description."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.datasets.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ListedView,
    PosesTable,
    SplitTable,
    StampsTable,
    check_camera,
)
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.messages import decode_file
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.records import Float64

CAMERA = "camera"  # the name of a layout's only lens
MILLIMETRE = 1e-3
SAME = 1e-6  # largest entry of a matrix that is the identity
_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm"})


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A layout, in the ``ENTRIES`` of its module: its name, whether a folder has it, and the folder as a description.

    Of layouts that a folder has, that of the lowest `order` counts. `docs` are its rows in docs/input.md, cells
    between bars, an empty line between rows: layout, what it is known by, poses, depth, intrinsics.
    """

    name: str
    order: int
    matches: Callable[[Path], bool]
    read: Callable[[Path, SourceOptions], Description]
    docs: str = ""


class Lenses:
    """The different lenses of a layout's views, as cameras ``camera``, ``camera-1``, ``camera-2``, ..."""

    def __init__(self) -> None:
        self._tables: list[CameraTable] = []

    def __len__(self) -> int:
        return len(self._tables)

    def named(self, table: CameraTable, where: str) -> CameraTable:
        """The camera of a lens; a new one where no view before had it. Raises InputError as `check_camera`."""
        for known in self._tables:
            if asdict(replace(known, name=table.name)) == asdict(table):
                return known
        check_camera(table, where)
        number = len(self._tables)
        self._tables.append(replace(table, name=table.name if number == 0 else f"{table.name}-{number}"))
        return self._tables[-1]


def described(
    path: Path,
    root: Path,
    views: Sequence[ListedView],
    *,
    poses: PosesTable,
    camera: CameraTable | None = None,
    depth_camera: CameraTable | None = None,
    depth: DepthTable | None = None,
    has_stamps: bool = False,
    is_depth_resized: bool = False,
    unpaired: tuple[int, int] = (0, 0),
    notes: tuple[str, ...] = (),
) -> Description:
    """The description of listed views, of `camera` where they name no lens of their own.

    Raises InputError where there is none, or the camera is impossible.
    """
    if not views:
        raise InputError(f"{path}: no colour image has a depth image", remedy="check that the folder is whole")
    for table in (camera, depth_camera):
        if table is not None:
            check_camera(table, str(path))
    return Description(
        path=path,
        root=root,
        poses=poses,
        camera=camera or views[0].camera,
        depth_camera=depth_camera,
        frames=None,
        depth=depth or DepthTable(),
        stamps=StampsTable(names=has_stamps),
        split=SplitTable(),
        listed=tuple(views),
        is_depth_resized=is_depth_resized,
        unpaired=unpaired,
        notes=notes,
    )


def given_lens(options: SourceOptions, image: Path) -> CameraTable | None:
    """The lens that --intrinsics gives for camera ``camera``, of the size of `image`; None where it gives none."""
    values = options.intrinsics.get(CAMERA)
    return None if values is None else pinhole(values, image)


def pinhole(values: Sequence[float], image: Path, distortion: Sequence[float] = ()) -> CameraTable:
    """A lens of fx, fy, cx, cy [px] and the size of an image file."""
    width, height = image_size(image)
    fx, fy, cx, cy = values
    return CameraTable(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=list(distortion))


def own_depth_camera(color: CameraTable, depth: CameraTable, T_color_depth: Float64) -> CameraTable | None:
    """The depth camera with its place in the colour camera; None where it is the colour camera."""
    if depth == color and np.abs(T_color_depth - np.eye(4)).max() <= SAME:
        return None
    return replace(depth, depth_to_color=T_color_depth.tolist())


def image_size(path: Path) -> tuple[int, int]:
    """Columns and rows of an image file. Raises InputError where it is none."""
    try:
        pixels = decode_file(path.read_bytes(), color=False)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}", remedy="check that the folder is whole") from None
    if pixels is None:
        raise InputError(f"{path}: not an image that can be read", remedy="check that the folder is whole")
    return int(pixels.shape[1]), int(pixels.shape[0])


def images_of(folder: Path) -> dict[str, Path]:
    """Image files by stem, in the order of the numbers in their names."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in _IMAGES]
    return {path.stem: path for path in sorted(files, key=lambda p: by_numbers(p.stem))}


def by_numbers(name: str) -> tuple[list[int], str]:
    """Key that sorts names by the numbers in them (2 before 10)."""
    return [int(number) for number in re.findall(r"\d+", name)], name


def pose_or_none(matrix: Float64) -> Float64 | None:
    """A pose file's matrix, None where it is not finite: how trackers write that they were lost."""
    return matrix if np.isfinite(matrix).all() else None


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises InputError where it is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: not readable JSON: {error}", remedy="check that the folder is whole") from None
