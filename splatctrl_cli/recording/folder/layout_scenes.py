"""Room scenes with a trajectory or a pose per frame: 7-Scenes, Open3D, Redwood, Replica.

7-Scenes and its kin: ``frame-NNNNNN.color.*``, ``.depth.*``, ``.pose.txt``, in one folder, ``seq-NN/``, ``data/``.
Depth is in millimetres, 65535 = none; poses are camera to world. Calibrations:

- ``info.txt`` of ScanNet's SensReader: the user describes the folder;
- ``camera-intrinsics.txt``, one 3x3 matrix for colour and depth (3DMatch, Zeng et al., CVPR 2017);
- none: 7-Scenes publishes intrinsics and poses of the depth camera; colour is not registered (Shotton et al., CVPR
  2013). Colour's lens and pose are another Kinect's, as in ACE (nianticlabs/ace, datasets/setup_7scenes.py).

Open3D and Redwood: a colour folder, ``depth/``, ``trajectory.log``, ``camera_intrinsic.json``, named as in
open3d.data. Poses are camera to world (examples/python/reconstruction_system/integrate_scene.py). Images match poses
in natural order (open3d_example.py, get_rgbd_file_lists), or by number if their counts differ.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, refuse_faults
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ListedView,
    PosesTable,
)
from splatctrl_cli.recording.folder.layout import (
    Layout,
    ask_description,
    describe,
    find_marks,
    images_of,
    lens_option,
    list_views,
    move_poses,
    number_key,
    own_depth_camera,
    pinhole,
    pose_or_none,
    read_json,
    read_K,
)
from splatctrl_cli.recording.folder.poses import read_matrix_file, read_trajectory_log, rigid
from splatctrl_cli.recording.source_options import SourceOptions

DEPTH_LENS = (585.0, 585.0, 320.0, 240.0)
COLOR_LENS = (525.0, 525.0, 320.0, 240.0)
T_COLOR_DEPTH = rigid(
    np.array(
        [
            [0.99996518012567637, 0.0026765126468950343, -0.0079041012313000904, -0.025558943178152542],
            [-0.00274093112813167, 0.99996302803027592, -0.0081504520778013286, 0.00010109636268061706],
            [0.0078819942130445332, 0.0081718328771890631, 0.99993554558014031, 0.0020318321729487039],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
    "7-Scenes",
)
_SEQUENCES = ("", "seq-*/", "data/", "sequence/")
_NOTE = (
    "7-Scenes publishes no calibration of colour: depth (585, 585, 320, 240, whose poses these are) is registered to"
    " colour by another Kinect's (525, 525, 320, 240, 26 mm apart); --intrinsics camera=FX,FY,CX,CY takes both as one"
)


def read_frames(folder: Path, options: SourceOptions) -> Description:
    sequence = next(s for s in _SEQUENCES if next(folder.glob(f"{s}frame-*.pose.txt"), None) is not None)
    colors = _files(folder, f"{sequence}frame-*.color.*", ".color")
    depths = _files(folder, f"{sequence}frame-*.depth.*", ".depth")
    poses = (folder / f"{name}.pose.txt" for name in colors)
    matrices = {
        name: pose_or_none(read_matrix_file(file)) for name, file in zip(colors, poses, strict=True) if file.is_file()
    }
    views = [
        ListedView(name=name, color=color, depth=depths[name], matrix=matrices.get(name))
        for name, color in colors.items()
        if name in depths
    ]
    pairs = list_views(folder, views, len(colors), len(depths))
    first = pairs.listed[0]
    places = (colors[first.name].parent, folder, folder.parent)
    if any((place / name).is_file() for place in places for name in ("_info.txt", "info.txt")):
        return ask_description("12-Scenes", "twelve_scenes")(folder, options)
    published = (place / "camera-intrinsics.txt" for place in (folder, folder.parent))
    values = next((read_K(file) for file in published if file.is_file()), DEPTH_LENS)
    depth_camera = None
    if is_7_scenes := lens_option(options, first.color) is None and values == DEPTH_LENS:
        values, lens = COLOR_LENS, pinhole(COLOR_LENS, first.color)
        depth_camera = own_depth_camera(lens, pinhole(DEPTH_LENS, depths[first.name]), T_COLOR_DEPTH)
        pairs = move_poses(pairs, lambda T: T @ invert_transform(T_COLOR_DEPTH))
    return describe(
        pairs,
        folder,
        options,
        poses=PosesTable(format="matrix-files", file=f"{sequence}frame-*.pose.txt"),
        lens=lambda image: pinhole(values, image),
        depth_camera=depth_camera,
        depth=DepthTable(invalid=65535),
        notes=(_NOTE,) if is_7_scenes else (),
    )


def _files(folder: Path, pattern: str, kind: str) -> dict[str, Path]:
    paths = sorted(folder.glob(pattern), key=lambda p: number_key(p.relative_to(folder).as_posix()))
    return {path.relative_to(folder).as_posix().partition(kind)[0]: path for path in paths}


COLOR_FOLDERS = ("color", "colors", "image", "rgb")
TRAJECTORIES = (
    "trajectory.log",
    "scene/trajectory.log",  # as run_system.py writes it
    "trajectory_*.log",
    "*_trajectory.log",  # Stanford's scenes (lounge_trajectory.log)
    "*-traj.txt",  # augmented ICL-NUIM (livingroom1-traj.txt)
    "odometry.log",
    "bedroom.log",
)
INTRINSICS = ("camera_intrinsic.json", "camera_intrinsics.json", "intrinsic.json", "camera_primesense.json")


def read_redwood(folder: Path, options: SourceOptions) -> Description:
    """Describe the folder; depth in millimetres."""
    trajectory = next(path for pattern in TRAJECTORIES for path in sorted(folder.glob(pattern)))
    colors = images_of(next(folder / name for name in COLOR_FOLDERS if (folder / name).is_dir()))
    depths = images_of(folder / "depth")
    pairs = _pairs(list(colors), list(depths))
    poses = read_trajectory_log(trajectory)
    is_by_place = len(poses) == len(pairs)
    views = [
        ListedView(
            name=color,
            color=colors[color],
            depth=depths[depth],
            matrix=poses.get(str(place) if is_by_place else str(_number(color))),
        )
        for place, (color, depth) in enumerate(pairs)
    ]
    return describe(
        list_views(trajectory, views, len(colors), len(depths)),
        folder,
        options,
        poses=PosesTable(format="trajectory-log", file=trajectory.relative_to(folder).as_posix()),
        lens=lambda _: _redwood_lens(folder),
    )


def _pairs(colors: list[str], depths: list[str]) -> list[tuple[str, str]]:
    """Pair by equal names; else in order if as many; else by first numbers."""
    same = [(name, name) for name in colors if name in depths]
    if same or len(colors) == len(depths):
        return same or list(zip(colors, depths, strict=True))
    by_number = {_number(name): name for name in depths}
    return [(name, by_number[_number(name)]) for name in colors if _number(name) in by_number]


def _number(name: str) -> int:
    match = re.search(r"\d+", name)
    return int(match[0]) if match else -1


def _redwood_lens(folder: Path) -> CameraTable:
    for file in (parent / name for parent in (folder, folder.parent) for name in INTRINSICS):
        if file.is_file():
            content = read_json(file)
            with refuse_faults(
                partial("{}: expected width, height and intrinsic_matrix (9 numbers), got no {}".format, file),
                KeyError,
                TypeError,
                ValueError,
                remedy="write it with Open3D, or give --intrinsics camera=FX,FY,CX,CY",
            ):
                fx, _, _, _, fy, _, cx, cy, _ = (float(value) for value in content["intrinsic_matrix"])  # by columns
                return CameraTable(
                    width=int(content["width"]), height=int(content["height"]), fx=fx, fy=fy, cx=cx, cy=cy
                )
    raise InputError(
        f"{folder}: no {INTRINSICS[0]} in it or above it",
        remedy="give --intrinsics camera=FX,FY,CX,CY (Redwood's default: 525,525,319.5,239.5)",
    )


ENTRIES = (
    Layout(
        name="7-Scenes",
        order=3,
        matches=find_marks(*(f"{sequence}frame-*.pose.txt" for sequence in _SEQUENCES)),
        read=read_frames,
        docs="""
7-Scenes | `frame-*.pose.txt`, also in `seq-*/` | of the depth camera | 1 mm, 65535 = none, registered to colour |
    depth 585, 585, 320, 240; colour 525, 525, 320, 240; `--intrinsics` takes both as one

3DMatch | the same, `camera-intrinsics.txt` | a file a frame | as above, not registered | of that file; 585, 585,
    320, 240 counts as 7-Scenes

12-Scenes, BundleFusion, 3RScan | the same, `info.txt` or `_info.txt` | by [description](#datasets-by-description)
""",
    ),
    Layout(
        name="Open3D scene",
        order=9,
        matches=find_marks(*(f"{color}/ depth/ {path}" for color in COLOR_FOLDERS for path in TRAJECTORIES)),
        read=read_redwood,
        docs="""
Open3D, Redwood | `color/` (`colors/`, `image/`, `rgb/`), `depth/`, `trajectory.log` (`*_trajectory.log`,
    `*-traj.txt`) | by order; by number where there are more poses than images | 1 mm | `camera_intrinsic.json`,
    else `--intrinsics`
""",
    ),
    Layout(
        name="ScanNet export",
        order=2,
        matches=find_marks(*(f"color/ depth/ pose/ {lens}" for lens in ("intrinsic/", "intrinsics_color.txt"))),
        read=ask_description("ScanNet export", "scannet"),
        docs="""
ScanNet export | `color/`, `depth/`, `pose/`, `intrinsic/` (or `intrinsics_color.txt`) | by
    [description](#datasets-by-description)
""",
    ),
    Layout(
        name="ICL-NUIM",
        order=5,
        matches=find_marks("rgb/ depth/ *.gt.freiburg"),
        read=ask_description("ICL-NUIM", "icl_nuim"),
        docs="""
ICL-NUIM, TUM-compatible | `rgb/`, `depth/`, `*.gt.freiburg` | by [description](#datasets-by-description)
""",
    ),
    Layout(
        name="Replica",
        order=6,
        matches=find_marks("traj.txt results/frame*", "traj_w_c.txt rgb/rgb_*"),
        read=ask_description("Replica", "replica_nice_slam", "replica_semantic_nerf"),
        docs="""
Replica of NICE-SLAM or Semantic-NeRF | `traj.txt`, `results/frame*`; `traj_w_c.txt`, `rgb/rgb_*` | by
    [description](#datasets-by-description)
""",
    ),
)
