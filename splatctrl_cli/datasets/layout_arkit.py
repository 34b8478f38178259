"""ARKitScenes: ``lowres_wide/``, ``lowres_depth/``, ``lowres_wide_intrinsics/`` and ``lowres_wide.traj``.

Images are named by video and seconds; depth in millimetres; a ``.pincam`` for each image holds width, height, fx, fy,
cx, cy; a line of the trajectory is seconds, a rotation vector and a translation [m], world to camera
(apple/ARKitScenes, DATA.md, and threedod/benchmark_scripts/utils/tenFpsDataLoader.py). Poses are interpolated as
those of tf.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.datasets.folder_description import CameraTable, Description, ListedView, PosesTable
from splatctrl_cli.datasets.layout import Layout, Lenses, described, images_of, paired_by_stamp
from splatctrl_cli.datasets.poses import Trajectory, read_numbers, read_rows, stamp_of_text
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform, pose_at
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import Float64

TRAJECTORY = "lowres_wide.traj"


def matches(folder: Path) -> bool:
    """Whether the folder is one video's, or holds its ``*_frames``."""
    return _frames(folder) is not None


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; lenses that differ become cameras of their own."""
    options.refuse(("intrinsics",), "a video of ARKitScenes", folder)
    root = _frames(folder)
    assert root is not None
    colors, depths = _by_stamp(root / "lowres_wide"), _by_stamp(root / "lowres_depth")
    trajectory = Trajectory(_poses(root / TRAJECTORY))
    pairs = paired_by_stamp(root / TRAJECTORY, colors, depths, trajectory.at, options)
    lenses = Lenses()
    pincams = {
        stamp: path
        for path in sorted((root / "lowres_wide_intrinsics").glob("*.pincam"))
        if (stamp := _stamp_ns(path))
    }
    views = [replace(view, camera=lenses.named(_lens(pincams, view), str(root))) for view in pairs.views]
    return described(
        replace(pairs, views=views),
        root,
        options,
        poses=PosesTable(format="rotation-vectors", file=TRAJECTORY),
        has_stamps=True,
        is_depth_resized=True,
    )


def _frames(folder: Path) -> Path | None:
    candidates = (folder, *sorted(folder.glob("*_frames")))
    return next((f for f in candidates if (f / TRAJECTORY).is_file() and (f / "lowres_depth").is_dir()), None)


def _by_stamp(folder: Path) -> list[tuple[int, Path]]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder", remedy="download lowres_wide and lowres_depth")
    return [(stamp_ns, path) for path in images_of(folder).values() if (stamp_ns := _stamp_ns(path)) is not None]


def _stamp_ns(path: Path) -> int | None:
    """Of ``41069021_305.367.png``."""
    return stamp_of_text(path.stem.rpartition("_")[2])


def _poses(path: Path) -> dict[str, Float64]:
    """T_world_camera by stamp [s] as written."""
    poses = {}
    for where, words, values in read_rows(path):
        if len(values) != 7 or not np.isfinite(values).all():
            raise InputError(
                f"{where}: expected seconds, a rotation vector and a translation, got {' '.join(words)!r}",
                remedy="copy the file again",
            )
        poses[words[0]] = invert_transform(pose_at(values[4:], cv2.Rodrigues(np.array(values[1:4]))[0]))
    return poses


def _lens(pincams: dict[int, Path], view: ListedView) -> CameraTable:
    assert view.stamp_ns is not None
    stamp_ns = view.stamp_ns
    near = min(pincams, key=lambda stamp: abs(stamp - stamp_ns), default=None)
    if near is None or abs(near - stamp_ns) > 5_000_000:  # the two names are rounded apart
        raise InputError(
            f"{view.color}: no .pincam of its stamp in lowres_wide_intrinsics",
            remedy="download lowres_wide_intrinsics",
        )
    values = read_numbers(pincams[near])
    if len(values) != 6 or not np.isfinite(values).all():
        raise InputError(
            f"{pincams[near]}: expected width, height, fx, fy, cx, cy, got {values}", remedy="copy the file again"
        )
    width, height, fx, fy, cx, cy = values
    return CameraTable(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)


_DOCS = """
ARKitScenes | `lowres_wide.traj`, `lowres_depth/`, also in `*_frames/` | world to camera, interpolated | 1 mm, of
    another size: nearest pixels | a `.pincam` per image
"""
ENTRIES = (Layout(name="ARKitScenes", order=7, matches=matches, read=read, docs=_DOCS),)
