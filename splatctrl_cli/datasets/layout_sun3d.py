"""SUN3D: ``image/NUMBER-MICROSECONDS.jpg``, ``depth/NUMBER-MICROSECONDS.png``, ``intrinsics.txt``, ``extrinsics/``.

As the dataset's own reader takes them (SUN3DreaderWithAnnotation, readSUN3Dannotation.m): depth with its bits rotated
left by three, in millimetres, registered to colour; the depth nearest in time belongs to an image; the last file of
``extrinsics/`` holds a 3x4 matrix for each image in order, camera to world; the first pixel's centre is at 1.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.datasets.folder_description import DepthTable, Description, PosesTable
from splatctrl_cli.datasets.layout import Layout, described, images_of, paired_by_stamp, pinhole, pose_or_none, read_K
from splatctrl_cli.datasets.poses import read_numbers, stamp_of_text
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import Float64


def matches(folder: Path) -> bool:
    """Whether the folder is such a sequence."""
    has_folders = all((folder / name).is_dir() for name in ("image", "depth", "extrinsics"))
    return has_folders and (folder / "intrinsics.txt").is_file()


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; images within the pairing tolerance of a depth image."""
    colors, depths = _by_stamp(folder / "image"), _by_stamp(folder / "depth")
    extrinsics = sorted((folder / "extrinsics").glob("*.txt"))
    poses = _poses(extrinsics[-1]) if extrinsics else []
    at = {stamp_ns: pose_or_none(poses[index]) for index, (stamp_ns, _) in enumerate(colors) if index < len(poses)}
    return described(
        paired_by_stamp(folder, colors, depths, at.get, options),
        folder,
        options,
        poses=PosesTable(format="matrix-rows", file="extrinsics/*.txt"),
        lens=lambda image: replace(pinhole(read_K(folder / "intrinsics.txt"), image), pixel_center=1.0),
        depth=DepthTable(encoding="uint16-rotated3"),
        has_stamps=True,
    )


def _by_stamp(folder: Path) -> list[tuple[int, Path]]:
    found = [(stamp_of_text(f"{path.stem.partition('-')[2]}e-6"), path) for path in images_of(folder).values()]
    return [(stamp_ns, path) for stamp_ns, path in found if stamp_ns is not None]


def _poses(path: Path) -> list[Float64]:
    """T_world_camera (4, 4) of each image."""
    values = read_numbers(path)
    if len(values) % 12:
        raise InputError(f"{path}: expected 3x4 matrices, got {len(values)} numbers", remedy="copy the file again")
    rows = np.array(values).reshape(-1, 3, 4)
    bottom = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(rows), 1, 4))
    return list(np.concatenate([rows, bottom], axis=1))


_DOCS = """
SUN3D | `image/`, `depth/`, `extrinsics/`, `intrinsics.txt` | the newest file of `extrinsics/`, by order | 1 mm,
    bits rotated by three, paired within 20 ms | `intrinsics.txt`, the first pixel's centre at 1
"""
ENTRIES = (Layout(name="SUN3D", order=8, matches=matches, read=read, docs=_DOCS),)
