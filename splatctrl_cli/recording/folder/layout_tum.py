"""Layouts with images paired by stamp: TUM RGB-D and its kin, and SUN3D.

TUM RGB-D: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``. Depth counts 1/5000 m, registered to raw colour; poses are
the colour camera's (the dataset's page; Sturm et al., IROS 2012). Bonn RGB-D Dynamic (Palazzolo et al., IROS 2019):
T_camera = T_ros^-1 T_groundtruth T_ros T_m, of its page, without the scale of 1.059 in T_m's rotation. ETH3D SLAM
(Schöps et al., CVPR 2019) has ``calibration.txt`` with fx, fy, cx, cy.

SUN3D: ``image/NUMBER-MICROSECONDS.jpg``, ``depth/NUMBER-MICROSECONDS.png``, ``intrinsics.txt``, ``extrinsics/``, as
in its reader (SUN3DreaderWithAnnotation, readSUN3Dannotation.m). Depth is in millimetres with bits rotated left by
three, registered to the colour image nearest in time. The last file of ``extrinsics/`` has a 3x4 matrix per image in
order, camera to world; the first pixel's centre is at 1.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ImageFile,
    PosesTable,
)
from splatctrl_cli.recording.folder.layout import (
    Layout,
    describe,
    find_marks,
    images_of,
    move_poses,
    pair_stamps,
    pinhole,
    pose_or_none,
    read_K,
)
from splatctrl_cli.recording.folder.poses import read_numbers, rigid, stamp_of_text, trajectory, tum_rows
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64

SCALE = 1.0 / 5000.0  # [m] per count

SERIES: Mapping[str, tuple[tuple[float, float, float, float], tuple[float, ...]]] = {
    # pattern in the name: fx, fy, cx, cy; k1, k2, p1, p2, k3
    "(freiburg|fr)_?1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "(freiburg|fr)_?2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "(freiburg|fr)_?3": ((535.4, 539.2, 320.1, 247.6), ()),
    "bonn": (
        (542.822841, 542.576870, 315.593520, 237.756098),
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    ),
}

_BONN_T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])

_BONN_SCALE = 1.0593  # of the rotation below, as published

_BONN_T_M = np.array(
    [
        [1.0157 / _BONN_SCALE, 0.1828 / _BONN_SCALE, -0.2389 / _BONN_SCALE, 0.0113],
        [0.0009 / _BONN_SCALE, -0.8431 / _BONN_SCALE, -0.6413 / _BONN_SCALE, -0.0098],
        [-0.3009 / _BONN_SCALE, 0.6147 / _BONN_SCALE, -0.8085 / _BONN_SCALE, 0.0111],
        [0.0, 0.0, 0.0, 1.0],
    ]
)

_BONN_NOTE = (
    "Bonn: poses are moved from the markers to the camera as its page says, without the scale of 1.059 in that"
    " transform; depth is as published (--depth-scale 2.1186e-4 scales it by as much)"
)


def read_tum_folder(folder: Path, options: SourceOptions) -> Description:
    colors, depths = list_files(folder / "rgb.txt"), list_files(folder / "depth.txt")
    series = _series(folder)
    file = folder / "groundtruth.txt"
    rows = tum_rows(file) if file.is_file() else {}
    num_lost = sum(T is None for T in rows.values())
    lost = (f"{file.name}: {num_lost} of {len(rows)} lines are no pose (nan)",) if num_lost else ()
    pairs = pair_stamps(folder / "rgb.txt", colors, depths, trajectory(rows), options)
    return describe(
        move_poses(pairs, marker_to_camera) if series == "bonn" else pairs,
        folder,
        options,
        poses=PosesTable(format="tum", file=file.name),
        lens=lambda image: _lens(folder, series, image),
        depth=DepthTable(scale=SCALE),
        has_stamps=True,
        notes=((_BONN_NOTE,) if series == "bonn" else ()) + lost,
    )


def list_files(path: Path) -> list[tuple[int, Path]]:
    """Stamp [ns] and file of lines ``stamp path``."""
    files = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        if words and not line.startswith("#"):
            stamp_ns = stamp_of_text(words[0])
            if stamp_ns is None or len(words) != 2:
                raise InputError(f"{path}:{number}: expected 'stamp file', got {line!r}", remedy="correct the line")
            files.append((stamp_ns, path.parent / words[1].replace("\\", "/")))
    return files


def _series(folder: Path) -> str:
    names = [folder.resolve().name]
    for file in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        if (folder / file).is_file():
            with (folder / file).open(encoding="utf-8", errors="replace") as stream:
                names += [line for line in stream.readlines(1000)[:4] if line.startswith("#")]
    pairs = ((name.lower(), series) for name in names for series in SERIES)
    return next((series for name, series in pairs if re.search(rf"(?<![a-z]){series}(?!\d)", name)), "")


def _lens(folder: Path, series: str, image: ImageFile) -> CameraTable:
    calibration = folder / "calibration.txt"
    if calibration.is_file():
        values = read_numbers(calibration)
        refuse_if(
            len(values) != 4,
            f"{calibration}: expected fx fy cx cy, got {len(values)} numbers",
            remedy="correct the file, or give --intrinsics camera=FX,FY,CX,CY",
        )
        return pinhole(values, image)
    if series:
        lens, distortion = SERIES[series]
        return pinhole(lens, image, distortion)
    raise InputError(
        f"{folder}: expected calibration.txt, or a name with one of freiburg1, freiburg2, freiburg3, bonn, whose"
        f" cameras are known, got {folder.name!r}",
        remedy="give --intrinsics camera=FX,FY,CX,CY (the Kinect's default: 525,525,319.5,239.5)",
    )


def marker_to_camera(T_ground_truth: Float64) -> Float64:
    """T_world_camera (4, 4) of a pose in Bonn's groundtruth.txt."""
    return np.asarray(_BONN_T_ROS.T @ T_ground_truth @ _BONN_T_ROS @ rigid(_BONN_T_M, "Bonn's T_m"))


def read_sun3d(folder: Path, options: SourceOptions) -> Description:
    colors, depths = _list_by_stamp(folder / "image"), _list_by_stamp(folder / "depth")
    extrinsics = sorted((folder / "extrinsics").glob("*.txt"))
    poses = _poses(extrinsics[-1]) if extrinsics else []
    at = {stamp_ns: pose_or_none(poses[index]) for index, (stamp_ns, _) in enumerate(colors) if index < len(poses)}
    return describe(
        pair_stamps(folder, colors, depths, at.get, options),
        folder,
        options,
        poses=PosesTable(format="matrix-rows", file="extrinsics/*.txt"),
        lens=lambda image: replace(pinhole(read_K(folder / "intrinsics.txt"), image), pixel_center=1.0),
        depth=DepthTable(encoding="uint16-rotated3"),
        has_stamps=True,
    )


def _list_by_stamp(folder: Path) -> list[tuple[int, Path]]:
    stamped = [(stamp_of_text(f"{path.stem.partition('-')[2]}e-6"), path) for path in images_of(folder).values()]
    return [(stamp_ns, path) for stamp_ns, path in stamped if stamp_ns is not None]


def _poses(path: Path) -> list[Float64]:
    values = read_numbers(path)
    refuse_if(
        len(values) % 12, f"{path}: expected 3x4 matrices, got {len(values)} numbers", remedy="copy the file again"
    )
    rows = np.array(values).reshape(-1, 3, 4)
    return list(np.concatenate([rows, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(rows), 1, 4))], axis=1))


ENTRIES = (
    Layout(
        name="TUM RGB-D",
        order=0,
        matches=find_marks("rgb.txt depth.txt"),
        read=read_tum_folder,
        docs="""
TUM RGB-D | `rgb.txt`, `depth.txt` | `groundtruth.txt`, interpolated | 1/5000 m, paired within 20 ms | by freiburg1,
    2 or 3 in the folder's name or the lists, else `--intrinsics`

Bonn RGB-D Dynamic | the same, `bonn` in the name | moved from the markers to the camera | without the published
    scale of 1.059 | of its page

ETH3D SLAM | the same, `calibration.txt` | as TUM | as TUM | fx, fy, cx, cy
""",
    ),
    Layout(
        name="SUN3D",
        order=8,
        matches=find_marks("image/ depth/ extrinsics/ intrinsics.txt"),
        read=read_sun3d,
        docs="""
SUN3D | `image/`, `depth/`, `extrinsics/`, `intrinsics.txt` | the newest file of `extrinsics/`, by order | 1 mm,
    bits rotated by three, paired within 20 ms | the first pixel's centre at 1
""",
    ),
)
