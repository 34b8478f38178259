"""nerfstudio's ``transforms.json`` with depth: lens, files and pose of each frame, or one lens for all.

Its fields, their defaults and the half pixel of the principal point are those of nerfstudio's documentation
("Data conventions") and of nerfstudio/data/dataparsers/nerfstudio_dataparser.py.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ListedView,
    PosesTable,
    SplitTable,
    StampsTable,
)
from splatctrl_cli.io.layout import Lenses
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.poses import read_nerfstudio

FILE = "transforms.json"
_MODELS = {**dict.fromkeys(["OPENCV", "PINHOLE", "SIMPLE_MODELS"], "plumb_bob"), "OPENCV_FISHEYE": "equidistant"}


def matches(folder: Path) -> bool:
    """Whether the folder has a transforms.json."""
    return (folder / FILE).is_file()


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; depth is in millimetres unless --depth-scale says otherwise."""
    options.refuse(("intrinsics",), "a folder with transforms.json", folder)
    description = Description(
        path=folder / FILE,
        root=folder,
        poses=PosesTable(format="nerfstudio", file=FILE, axes="opengl"),
        camera=None,
        depth_camera=None,
        frames=None,
        depth=DepthTable(),
        stamps=StampsTable(),
        split=SplitTable(),
    )
    return with_transforms(description)


def with_transforms(description: Description) -> Description:
    """With the camera and the views of a transforms.json where the description leaves them to it."""
    table = description.poses
    is_whole = bool(description.listed or (description.camera and description.frames))
    if is_whole or table is None or table.format != "nerfstudio":
        return description
    path = description.root / table.file
    content, matrices = read_nerfstudio(path)
    lenses = Lenses()
    views = []
    for entry in content["frames"]:
        name = str(entry["file_path"])
        camera = description.camera or lenses.named(_camera(content, entry, path), str(path))
        if "depth_file_path" not in entry and description.frames is None:
            raise InputError(
                f"{path}: {name}: depth_file_path is missing",
                remedy="record depth, or give [frames] in a description (docs/input.md)",
            )
        views.append(
            ListedView(
                name=name,
                color=path.parent / name,
                depth=path.parent / str(entry.get("depth_file_path", "")),
                matrix=matrices[name],
                camera=camera,
            )
        )
    if not views:
        raise InputError(f"{path}: no frames", remedy="give a transforms.json with frames")
    if description.frames is not None:
        if len(lenses) > 1:
            raise InputError(
                f"{path}: {len(lenses)} different lenses beside [frames]",
                remedy="leave [frames] out, or give [camera]",
            )
        return replace(description, camera=views[0].camera)
    return replace(description, camera=views[0].camera, listed=tuple(sorted(_short(views), key=lambda v: v.name)))


def _camera(content: dict[str, Any], entry: dict[str, Any], path: Path) -> CameraTable:
    """The lens of a frame: its own values before those of the file."""
    said = {**content, **entry}
    model = str(said.get("camera_model", "OPENCV"))
    if model not in _MODELS:
        raise InputError(
            f"{path}: camera_model: expected one of {', '.join(_MODELS)}, got {model!r}",
            remedy="undistort the images",
        )
    keys = ("k1", "k2", "k3", "k4") if model == "OPENCV_FISHEYE" else ("k1", "k2", "p1", "p2", "k3")
    try:
        distortion = [float(said.get(key, 0.0)) for key in keys]
        return CameraTable(
            width=int(said["w"]),
            height=int(said["h"]),
            fx=float(said["fl_x"]),
            fy=float(said.get("fl_y", said["fl_x"])),
            cx=float(said["cx"]),
            cy=float(said["cy"]),
            pixel_center=0.5,  # nerfstudio's convention
            distortion=distortion if np.any(distortion) else [],
            distortion_model=_MODELS[model],
        )
    except (KeyError, TypeError, ValueError) as error:
        remedy = "give [camera] and [frames] in a description"
        raise InputError(f"{path}: {error} is missing", remedy=remedy) from None


def _short(views: list[ListedView]) -> list[ListedView]:
    """Views by the stem of their colour file where that is theirs alone, else by its path without suffix."""
    stems = [Path(view.name).stem for view in views]
    if len(set(stems)) == len(stems):
        return [replace(view, name=stem) for view, stem in zip(views, stems, strict=True)]
    return [replace(view, name=str(Path(view.name).with_suffix(""))) for view in views]
