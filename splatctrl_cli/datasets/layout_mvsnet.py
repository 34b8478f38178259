"""A scene in MVSNet's text form: ``cams/NUMBER_cam.txt``, ``pair.txt``, images, and depth (.pfm) where there is any.

By MVSNet's README ("File Formats") a camera file is the world-to-camera matrix, K, and ``DEPTH_MIN DEPTH_INTERVAL
[DEPTH_NUM [DEPTH_MAX]]``; others end in ``DEPTH_MIN DEPTH_MAX``. Images lie in ``images/`` (DTU's test set, Tanks and
Temples, ETH3D, colmap2mvsnet.py), in ``blended_images/`` (BlendedMVS) or beside ``cams/``; depth, in the cameras'
length, in ``rendered_depth_maps/`` (BlendedMVS) or any folder with ``depth`` in its name. No file says what that
length is.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from splatctrl_cli.config.fixed import PLAUSIBLE_DEPTH
from splatctrl_cli.datasets.dtu import fitted_intrinsics, read_camera_file
from splatctrl_cli.datasets.folder_description import CameraTable, DepthTable, Description, ListedView, PosesTable
from splatctrl_cli.datasets.layout import Layout, Lenses, Pairs, described, image_size, images_of
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import MILLIMETRE

_CAMERAS = "cams/*_cam.txt"
_NO_DEPTH = ("prob", "conf")  # in the names of maps beside depth
_ESTIMATED = ("est", "mvsnet")  # in the names of folders with a network's depth, which stands behind a measured one


def matches(folder: Path) -> bool:
    """Whether the folder is such a scene."""
    return next(folder.glob(_CAMERAS), None) is not None


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description, a lens for each K; --depth-scale is metres per length of cameras and depth."""
    options.refuse(("intrinsics",), "an MVSNet scene", folder)
    files = {path.name.removesuffix("_cam.txt"): path for path in sorted(folder.glob(_CAMERAS))}
    cameras = {stem: read_camera_file(path) for stem, path in files.items()}
    nearest = float(np.median([camera.nearest for camera in cameras.values()]))
    unit, notes = options.depth_scale, []
    if unit is None:
        unit = MILLIMETRE if nearest > PLAUSIBLE_DEPTH[1] else 1.0
        name = "metres" if unit == 1.0 else "millimetres"
        notes.append(
            f"lengths are taken as {name}, by a least depth of {nearest:g} in the camera files; they do not say:"
            " --depth-scale gives metres per unit"
        )
    colors = _images(folder, set(files))
    depths, without = _depths(folder)
    notes += without
    lenses, views = Lenses(), []
    for stem, color in colors.items():
        camera, depth = cameras[stem], depths.get(int(stem) if stem.isdigit() else -1)
        if depth is None and depths:
            continue
        k = fitted_intrinsics(camera.K, image_size(color), files[stem])
        matrix = camera.T_camera_world.copy()
        matrix[:3, 3] *= unit
        lens = CameraTable(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
        lens = lenses.named(lens, str(files[stem]))
        views.append(ListedView(name=stem, color=color, depth=depth, matrix=matrix, camera=lens))
    pairs = Pairs(path=folder, views=views, unpaired=(len(colors) - len(views), len(depths) - len(views)))
    return described(
        pairs,
        folder,
        options,
        poses=PosesTable(format="matrix-files", file=_CAMERAS, convention="world_to_camera"),
        depth=DepthTable(encoding="float32", scale=unit),
        is_depth_resized=True,
        supply="add a folder depths/ with a .pfm for each number, or describe the files in a .toml (docs/input.md)",
        notes=tuple(notes),
    )


def _images(folder: Path, stems: set[str]) -> dict[str, Path]:
    """The image of each camera, from the folder with most of them."""
    inner = [path for path in sorted(folder.iterdir()) if path.is_dir() and "depth" not in path.name.lower()]
    found = [{stem: path for stem, path in images_of(place).items() if stem in stems} for place in (*inner, folder)]
    most = max(found, key=len)
    if not most:
        raise InputError(
            f"{folder}: no image is named like a camera file ({min(stems)}_cam.txt)", remedy="copy the images too"
        )
    return most


def _depths(folder: Path) -> tuple[dict[int, Path], list[str]]:
    """Depth by number, and a note where folders with others are left out."""
    found = {
        path.name: dict(_maps(path)) for path in folder.iterdir() if path.is_dir() and "depth" in path.name.lower()
    }
    names = sorted((any(word in name for word in _ESTIMATED), name) for name, maps in found.items() if maps)
    if not names:
        return {}, []
    first, *others = (name for _, name in names)
    return found[first], [f"depth is that of {first}/, not of {', '.join(others)}"] if others else []


def _maps(folder: Path) -> Iterator[tuple[int, Path]]:
    for path in sorted(folder.glob("*.pfm")):
        number = re.search(r"\d+", path.stem)
        if number is not None and not any(word in path.stem for word in _NO_DEPTH):
            yield int(number[0]), path


_DOCS = """
MVSNet scene: DTU's test set, BlendedMVS, Tanks and Temples, colmap2mvsnet | `cams/*_cam.txt`, with `images/`,
    `blended_images/` or images beside it | world to camera, of the camera file | `.pfm` in a folder with `depth` in
    its name; metres, or millimetres where the files' least depth is over 20, or `--depth-scale` for poses and depth |
    of the camera file, for the image or a quarter of it
"""
ENTRIES = (Layout(name="MVSNet scene", order=10, matches=matches, read=read, docs=_DOCS),)
