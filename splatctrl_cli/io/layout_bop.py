"""BOP: one scene folder with ``scene_camera.json``, ``rgb/`` (or ``gray/``) and ``depth/``.

Lens, depth unit and pose of each image are its own: cam_K by rows [px], depth_scale counts to millimetres, cam_R_w2c
by rows and cam_t_w2c in millimetres (bop_toolkit, docs/bop_datasets_format.md).
"""

from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.folder_description import CameraTable, Description, ListedView, PosesTable
from splatctrl_cli.io.layout import MILLIMETRE, Lenses, described, image_size, images_of, read_json
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.records import Float64

FILE = "scene_camera.json"
_REMEDY = "see BOP's format of datasets"
COLOR_FOLDERS = ("rgb", "gray")


def matches(folder: Path) -> bool:
    """Whether the folder is a scene of BOP."""
    return (folder / FILE).is_file() and (folder / "depth").is_dir()


def read(folder: Path, options: SourceOptions) -> Description:
    """The scene as a description; a scene without cam_R_w2c has no poses."""
    options.refuse(("intrinsics",), "a BOP scene", folder)
    path = folder / FILE
    color_folder = next((folder / name for name in COLOR_FOLDERS if (folder / name).is_dir()), None)
    if color_folder is None:
        raise InputError(f"{folder}: expected a folder rgb or gray, got none", remedy="unpack the whole scene")
    colors, depths = images_of(color_folder), images_of(folder / "depth")
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected an object by image number, got {type(content).__name__}", remedy=_REMEDY)
    entries = {int(key): entry for key, entry in content.items() if key.isdigit()}
    lenses, views = Lenses(), []
    size = image_size(next(iter(colors.values()))) if colors else (0, 0)  # that of all images of a scene
    for name, color in colors.items():
        entry = entries.get(int(name)) if name.isdigit() else None
        if name not in depths or entry is None:
            continue
        where = f"{path}: image {int(name)}"
        try:
            lens = _lens(entry, size)
            view = ListedView(
                name=name,
                color=color,
                depth=depths[name],
                matrix=_pose(entry),
                camera=lenses.named(lens, where),
                depth_scale=float(entry["depth_scale"]) * MILLIMETRE,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{where}: expected BOP's fields, got no usable {error}", remedy=_REMEDY) from None
        views.append(view)
    return described(
        path,
        folder,
        views,
        poses=PosesTable(format="bop", file=FILE, convention="world_to_camera"),
        unpaired=(len(colors) - len(views), len(depths) - len(views)),
    )


def _lens(entry: dict[str, Any], size: tuple[int, int]) -> CameraTable:
    fx, _, cx, _, fy, cy, _, _, _ = (float(value) for value in entry["cam_K"])
    return CameraTable(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy)


def _pose(entry: dict[str, Any]) -> Float64 | None:
    """World to camera [m], None where the scene does not say."""
    if "cam_R_w2c" not in entry or "cam_t_w2c" not in entry:
        return None
    T = np.eye(4)
    T[:3, :3] = np.array(entry["cam_R_w2c"], dtype=np.float64).reshape(3, 3)
    T[:3, 3] = np.array(entry["cam_t_w2c"], dtype=np.float64) * MILLIMETRE
    return T
