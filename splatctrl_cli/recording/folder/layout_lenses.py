"""Layouts with a lens per image: ARKitScenes, BOP scenes, and MVSNet scenes.

ARKitScenes (apple/ARKitScenes, DATA.md, threedod/benchmark_scripts/utils/tenFpsDataLoader.py): images are named by
video and seconds; depth is in millimetres; a ``.pincam`` has width, height, fx, fy, cx, cy. Lines of
``lowres_wide.traj`` are seconds, rotation vector, translation [m], world to camera, interpolated like tf.

BOP (thodan/bop_toolkit, docs/bop_datasets_format.md): ``scene_camera.json`` has per image cam_K by rows [px],
depth_scale (counts to millimetres), cam_R_w2c by rows, cam_t_w2c in millimetres.

MVSNet: ``cams/NUMBER_cam.txt``, ``pair.txt``, images, optional depth (.pfm). A camera file is the world-to-camera
matrix, K, and ``DEPTH_MIN DEPTH_INTERVAL [DEPTH_NUM [DEPTH_MAX]]`` (README, "File Formats") or ``DEPTH_MIN
DEPTH_MAX``. Images: ``images/``, ``blended_images/`` (BlendedMVS) or next to ``cams/``. Depth, in the cameras'
unknown unit: any folder with ``depth`` in its name.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splatctrl_cli.config.fixed import PLAUSIBLE_DEPTH
from splatctrl_cli.errors import InputError, refuse_faults, refuse_if, require
from splatctrl_cli.geometry import invert_transform, pose_at
from splatctrl_cli.recording.folder.dtu import fit_intrinsics, read_camera_file
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ListedView,
    PosesTable,
)
from splatctrl_cli.recording.folder.layout import (
    CAMERA,
    Layout,
    add_lens,
    describe,
    find_marks,
    image_size,
    images_of,
    list_views,
    pair_stamps,
    read_json,
)
from splatctrl_cli.recording.folder.poses import read_numbers, read_rows, stamp_of_text, trajectory
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import MILLIMETRE, Float64

TRAJECTORY = "lowres_wide.traj"


def read_arkit(folder: Path, options: SourceOptions) -> Description:
    options.refuse(("intrinsics",), "a video of ARKitScenes", folder)
    root = _frames(folder)
    assert root is not None
    colors, depths = _list_by_stamp(root / "lowres_wide"), _list_by_stamp(root / "lowres_depth")
    pairs = pair_stamps(root / TRAJECTORY, colors, depths, trajectory(_poses(root / TRAJECTORY)), options)
    lenses: list[CameraTable] = []
    pincams = {
        stamp: path
        for path in sorted((root / "lowres_wide_intrinsics").glob("*.pincam"))
        if (stamp := _stamp_ns(path))
    }
    views = (replace(v, camera=add_lens(lenses, _arkit_lens(pincams, v), str(root))) for v in pairs.listed)
    return describe(
        replace(pairs, listed=tuple(views)),
        root,
        options,
        poses=PosesTable(format="rotation-vectors", file=TRAJECTORY),
        has_stamps=True,
        is_depth_resized=True,
    )


def _frames(folder: Path) -> Path | None:
    candidates = (folder, *sorted(folder.glob("*_frames")))
    return next((f for f in candidates if (f / TRAJECTORY).is_file() and (f / "lowres_depth").is_dir()), None)


def _list_by_stamp(folder: Path) -> list[tuple[int, Path]]:
    refuse_if(not folder.is_dir(), f"{folder}: no such folder", remedy="download lowres_wide and lowres_depth")
    return [(stamp_ns, path) for path in images_of(folder).values() if (stamp_ns := _stamp_ns(path)) is not None]


def _stamp_ns(path: Path) -> int | None:
    return stamp_of_text(path.stem.rpartition("_")[2])


def _poses(path: Path) -> dict[str, Float64]:
    poses = {}
    for where, words, values in read_rows(path):
        refuse_if(
            len(values) != 7 or not np.isfinite(values).all(),
            f"{where}: expected seconds, a rotation vector and a translation, got {' '.join(words)!r}",
            remedy="copy the file again",
        )
        poses[words[0]] = invert_transform(pose_at(values[4:], cv2.Rodrigues(np.array(values[1:4]))[0]))
    return poses


def _arkit_lens(pincams: dict[int, Path], view: ListedView) -> CameraTable:
    assert view.stamp_ns is not None
    stamp_ns = view.stamp_ns
    near = min(pincams, key=lambda stamp: abs(stamp - stamp_ns), default=None)
    if near is None or abs(near - stamp_ns) > 5_000_000:  # the two names are rounded separately
        raise InputError(
            f"{view.color}: no .pincam of its stamp in lowres_wide_intrinsics",
            remedy="download lowres_wide_intrinsics",
        )
    values = read_numbers(pincams[near])
    refuse_if(
        len(values) != 6 or not np.isfinite(values).all(),
        f"{pincams[near]}: expected width, height, fx, fy, cx, cy, got {values}",
        remedy="copy the file again",
    )
    width, height, fx, fy, cx, cy = values
    return CameraTable(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)


FILE = "scene_camera.json"
_REMEDY = "see BOP's format of datasets"
COLOR_FOLDERS = ("rgb", "gray")


def read_bop(folder: Path, options: SourceOptions) -> Description:
    """Describe the scene, without poses if cam_R_w2c is missing."""
    options.refuse(("intrinsics",), "a BOP scene", folder)
    views: list[ListedView] = []
    num_colors = num_depths = 0
    files = []
    for sensor in _sensors(folder):
        path = folder / f"{Path(FILE).stem}{sensor}.json"
        color_folder = next((f for name in COLOR_FOLDERS if (f := folder / f"{name}{sensor}").is_dir()), None)
        what = f"{folder}: expected a folder rgb{sensor} or gray{sensor}, got none"
        colors = images_of(require(color_folder, what, remedy="unpack the whole scene"))
        depths = images_of(folder / f"depth{sensor}")
        views += _views(path, sensor, colors, depths)
        files.append(path)
        num_colors, num_depths = num_colors + len(colors), num_depths + len(depths)
    name = FILE if len(files) == 1 else f"{Path(FILE).stem}*.json"
    return describe(
        list_views(files[0], views, num_colors, num_depths),
        folder,
        options,
        poses=PosesTable(format="bop", file=files[0].name if len(files) == 1 else name, convention="world_to_camera"),
    )


def _sensors(folder: Path) -> list[str]:
    stem = Path(FILE).stem
    sensors = sorted(path.stem.removeprefix(stem) for path in folder.glob(f"{stem}*.json"))
    return [sensor for sensor in sensors if (folder / f"depth{sensor}").is_dir()]


def _views(path: Path, sensor: str, colors: dict[str, Path], depths: dict[str, Path]) -> list[ListedView]:
    content = read_json(path)
    refuse_if(
        not isinstance(content, dict),
        f"{path}: expected an object by image number, got {type(content).__name__}",
        remedy=_REMEDY,
    )
    entries = {int(key): entry for key, entry in content.items() if key.isdigit()}
    lenses: list[CameraTable] = []
    views, prefix = [], sensor.removeprefix("_")
    size = image_size(next(iter(colors.values()))) if colors else (0, 0)  # that of all images of a scene
    for name, color in colors.items():
        entry = entries.get(int(name)) if name.isdigit() else None
        if name not in depths or entry is None:
            continue
        where = f"{path}: image {int(name)}"
        with refuse_faults(
            partial("{}: expected BOP's fields, got no usable {}".format, where),
            KeyError,
            TypeError,
            ValueError,
            remedy=_REMEDY,
        ):
            fx, _, cx, _, fy, cy, _, _, _ = (float(value) for value in entry["cam_K"])
            lens = CameraTable(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, name=prefix or CAMERA)
            view = ListedView(
                name=f"{prefix}/{name}" if prefix else name,
                color=color,
                depth=depths[name],
                matrix=_pose(entry),
                camera=add_lens(lenses, lens, where),
                depth_scale=float(entry["depth_scale"]) * MILLIMETRE,
            )
        views.append(view)
    return views


def _pose(entry: dict[str, Any]) -> Float64 | None:
    if "cam_R_w2c" not in entry or "cam_t_w2c" not in entry:
        return None
    return pose_at(
        np.array(entry["cam_t_w2c"], dtype=np.float64) * MILLIMETRE,
        np.array(entry["cam_R_w2c"], dtype=np.float64).reshape(3, 3),
    )


_CAMERAS = "cams/*_cam.txt"
_NO_DEPTH = ("prob", "conf")  # in the names of maps beside depth
_ESTIMATED = ("est", "mvsnet")  # in the names of folders with a network's depth, used only without a measured one


def read_mvsnet(folder: Path, options: SourceOptions) -> Description:
    """Describe the folder, a lens per K; --depth-scale: metres per unit."""
    options.refuse(("intrinsics",), "an MVSNet scene", folder)
    files = {path.name.removesuffix("_cam.txt"): path for path in sorted(folder.glob(_CAMERAS))}
    cameras = {stem: read_camera_file(path) for stem, path in files.items()}
    nearest = float(np.median([nearest for _, _, nearest in cameras.values()]))
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
    lenses: list[CameraTable] = []
    views = []
    for stem, color in colors.items():
        (K, T_camera_world, _), depth = cameras[stem], depths.get(int(stem) if stem.isdigit() else -1)
        if depth is None and depths:
            continue
        k = fit_intrinsics(K, image_size(color), files[stem])
        T_camera_world[:3, 3] *= unit
        lens = CameraTable(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
        lens = add_lens(lenses, lens, str(files[stem]))
        views.append(ListedView(name=stem, color=color, depth=depth, matrix=T_camera_world, camera=lens))
    return describe(
        list_views(folder, views, len(colors), len(depths)),
        folder,
        options,
        poses=PosesTable(format="matrix-files", file=_CAMERAS, convention="world_to_camera"),
        depth=DepthTable(encoding="float32", scale=unit),
        is_depth_resized=True,
        supply="add a folder depths/ with a .pfm for each number, or describe them in a .toml (splatctrl help input)",
        notes=tuple(notes),
    )


def _images(folder: Path, stems: set[str]) -> dict[str, Path]:
    inner = [path for path in sorted(folder.iterdir()) if path.is_dir() and "depth" not in path.name.lower()]
    by_folder = [
        {stem: path for stem, path in images_of(place).items() if stem in stems} for place in (*inner, folder)
    ]
    most = max(by_folder, key=len)
    refuse_if(
        not most,
        f"{folder}: no image is named like a camera file ({min(stems)}_cam.txt)",
        remedy="copy the images too",
    )
    return most


def _depths(folder: Path) -> tuple[dict[int, Path], list[str]]:
    by_folder = {
        path.name: dict(_maps(path)) for path in folder.iterdir() if path.is_dir() and "depth" in path.name.lower()
    }
    names = sorted((any(word in name for word in _ESTIMATED), name) for name, maps in by_folder.items() if maps)
    if not names:
        return {}, []
    first, *others = (name for _, name in names)
    return by_folder[first], [f"depth is that of {first}/, not of {', '.join(others)}"] if others else []


def _maps(folder: Path) -> Iterator[tuple[int, Path]]:
    for path in sorted(folder.glob("*.pfm")):
        number = re.search(r"\d+", path.stem)
        if number is not None and not any(word in path.stem for word in _NO_DEPTH):
            yield int(number[0]), path


ENTRIES = (
    Layout(
        name="ARKitScenes",
        order=7,
        matches=lambda folder: _frames(folder) is not None,
        read=read_arkit,
        docs="""
ARKitScenes | `lowres_wide.traj`, `lowres_depth/` | world to camera, interpolated | 1 mm, of another size: nearest
    pixels | a `.pincam` per image
""",
    ),
    Layout(
        name="BOP scene",
        order=1,
        matches=lambda folder: bool(_sensors(folder)),
        read=read_bop,
        docs="""
BOP scene | `scene_camera.json`, `depth/`; of several sensors `scene_camera_cam1.json`, `depth_cam1/` | `cam_R_w2c`,
    `cam_t_w2c`, else `--camera-pose` | `depth_scale` | `cam_K`
""",
    ),
    Layout(
        name="MVSNet scene",
        order=10,
        matches=find_marks(_CAMERAS),
        read=read_mvsnet,
        docs="""
MVSNet scene (DTU, BlendedMVS, Tanks and Temples, colmap2mvsnet) | `cams/*_cam.txt`, images | world to camera |
    `.pfm` in a folder with `depth` in its name; metres, millimetres where the least depth is over 20, or
    `--depth-scale` | of the image or a quarter of it
""",
    ),
)
