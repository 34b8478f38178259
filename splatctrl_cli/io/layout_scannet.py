"""ScanNet as its SensReader exports it: ``color/``, ``depth/``, ``pose/``, ``intrinsic/``.

Numbers in the names, depth in millimetres in a camera of its own, poses camera to world with -inf where tracking was
lost (SensReader/python/SensorData.py; "Data Organization" of the dataset's page).
"""

from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.folder_description import CameraTable, Description, ListedView, PosesTable
from splatctrl_cli.io.layout import described, given_lens, images_of, pinhole, pose_or_none
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.poses import read_matrix_file
from splatctrl_cli.records import Float64

SAME = 1e-6  # largest entry of an extrinsic matrix that is no transform


def matches(folder: Path) -> bool:
    """Whether the folder is such an export."""
    return all((folder / name).is_dir() for name in ("color", "depth", "pose", "intrinsic"))


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; depth is registered to colour unless both have the same lens."""
    colors, depths = images_of(folder / "color"), images_of(folder / "depth")
    views = [
        ListedView(name=name, color=colors[name], depth=depths[name], matrix=_pose(folder / "pose" / f"{name}.txt"))
        for name in colors
        if name in depths
    ]
    for name in ("extrinsic_color", "extrinsic_depth"):
        file = folder / "intrinsic" / f"{name}.txt"
        if file.is_file() and np.abs(read_matrix_file(file) - np.eye(4)).max() > SAME:
            raise InputError(
                f"{file}: expected the identity, as ScanNet's scans have, got a transform",
                remedy="describe the folder in a .toml with [depth_camera] depth_to_color",
            )
    color_lens = depth_lens = None
    if views:
        color_lens = given_lens(options, views[0].color) or _lens(folder, "intrinsic_color", views[0].color)
        depth_lens = _lens(folder, "intrinsic_depth", views[0].depth)
    return described(
        folder,
        folder,
        views,
        poses=PosesTable(format="matrix-files", file="pose/*.txt"),
        camera=color_lens,
        depth_camera=None if color_lens == depth_lens else depth_lens,
        unpaired=(len(colors) - len(views), len(depths) - len(views)),
    )


def _pose(path: Path) -> Float64 | None:
    return pose_or_none(read_matrix_file(path)) if path.is_file() else None


def _lens(folder: Path, name: str, image: Path) -> CameraTable:
    file = folder / "intrinsic" / f"{name}.txt"
    K = read_matrix_file(file)
    lens = pinhole((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), image)
    if abs(2 * lens.cx - lens.width) > 0.25 * lens.width:
        raise InputError(
            f"{file}: cx {lens.cx:g} is not near the middle of {image.name}, {lens.width} columns wide",
            remedy="scale the intrinsics with the images, or give --intrinsics camera=FX,FY,CX,CY",
        )
    return lens
