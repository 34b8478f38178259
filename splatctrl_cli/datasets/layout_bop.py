"""BOP: one scene folder with ``scene_camera.json``, ``rgb/`` (or ``gray/``) and ``depth/``.

Lens, depth unit and pose of each image are its own: cam_K by rows [px], depth_scale counts to millimetres, cam_R_w2c
by rows and cam_t_w2c in millimetres (thodan/bop_toolkit, docs/bop_datasets_format.md). Images are PNG, JPEG or TIFF.
Scenes of several sensors name them behind an underscore: ``scene_camera_cam1.json``, ``rgb_cam1/``, ``depth_cam1/``.
"""

from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.datasets.folder_description import CameraTable, Description, ListedView, PosesTable
from splatctrl_cli.datasets.layout import CAMERA, Layout, Lenses, Pairs, described, image_size, images_of, read_json
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import MILLIMETRE, Float64

FILE = "scene_camera.json"
_REMEDY = "see BOP's format of datasets"
COLOR_FOLDERS = ("rgb", "gray")


def matches(folder: Path) -> bool:
    """Whether the folder is a scene of BOP."""
    return bool(_sensors(folder))


def read(folder: Path, options: SourceOptions) -> Description:
    """The scene as a description; a scene without cam_R_w2c has no poses."""
    options.refuse(("intrinsics",), "a BOP scene", folder)
    views: list[ListedView] = []
    num_colors = num_depths = 0
    files = []
    for sensor in _sensors(folder):
        path = folder / f"{Path(FILE).stem}{sensor}.json"
        color_folder = next((f for name in COLOR_FOLDERS if (f := folder / f"{name}{sensor}").is_dir()), None)
        if color_folder is None:
            raise InputError(
                f"{folder}: expected a folder rgb{sensor} or gray{sensor}, got none", remedy="unpack the whole scene"
            )
        colors, depths = images_of(color_folder), images_of(folder / f"depth{sensor}")
        views += _views(path, sensor, colors, depths)
        files.append(path)
        num_colors, num_depths = num_colors + len(colors), num_depths + len(depths)
    name = FILE if len(files) == 1 else f"{Path(FILE).stem}*.json"
    return described(
        Pairs(path=files[0], views=views, unpaired=(num_colors - len(views), num_depths - len(views))),
        folder,
        options,
        poses=PosesTable(format="bop", file=files[0].name if len(files) == 1 else name, convention="world_to_camera"),
    )


def _sensors(folder: Path) -> list[str]:
    """What stands behind the names of each sensor's files: nothing for an only one, else ``_cam1``."""
    stem = Path(FILE).stem
    found = sorted(path.stem.removeprefix(stem) for path in folder.glob(f"{stem}*.json"))
    return [sensor for sensor in found if (folder / f"depth{sensor}").is_dir()]


def _views(path: Path, sensor: str, colors: dict[str, Path], depths: dict[str, Path]) -> list[ListedView]:
    """Those of one sensor."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected an object by image number, got {type(content).__name__}", remedy=_REMEDY)
    entries = {int(key): entry for key, entry in content.items() if key.isdigit()}
    lenses, views, prefix = Lenses(), [], sensor.removeprefix("_")
    size = image_size(next(iter(colors.values()))) if colors else (0, 0)  # that of all images of a scene
    for name, color in colors.items():
        entry = entries.get(int(name)) if name.isdigit() else None
        if name not in depths or entry is None:
            continue
        where = f"{path}: image {int(name)}"
        try:
            lens = _lens(entry, size, prefix or CAMERA)
            view = ListedView(
                name=f"{prefix}/{name}" if prefix else name,
                color=color,
                depth=depths[name],
                matrix=_pose(entry),
                camera=lenses.named(lens, where),
                depth_scale=float(entry["depth_scale"]) * MILLIMETRE,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{where}: expected BOP's fields, got no usable {error}", remedy=_REMEDY) from None
        views.append(view)
    return views


def _lens(entry: dict[str, Any], size: tuple[int, int], name: str) -> CameraTable:
    fx, _, cx, _, fy, cy, _, _, _ = (float(value) for value in entry["cam_K"])
    return CameraTable(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, name=name)


def _pose(entry: dict[str, Any]) -> Float64 | None:
    """World to camera [m], None where the scene does not say."""
    if "cam_R_w2c" not in entry or "cam_t_w2c" not in entry:
        return None
    return pose_at(
        np.array(entry["cam_t_w2c"], dtype=np.float64) * MILLIMETRE,
        np.array(entry["cam_R_w2c"], dtype=np.float64).reshape(3, 3),
    )


_DOCS = """
BOP scene | `scene_camera.json`, `depth/`; of several sensors `scene_camera_cam1.json`, `depth_cam1/` |
    `cam_R_w2c`, `cam_t_w2c`; else `--camera-pose` | `depth_scale` of each image | `cam_K` of each image
"""
ENTRIES = (Layout(name="BOP scene", order=1, matches=matches, read=read, docs=_DOCS),)
