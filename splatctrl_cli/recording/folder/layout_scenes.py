"""Scenes of rooms with one trajectory or a pose a frame: 7-Scenes and its kin, Open3D and Redwood, Replica.

7-Scenes and its kin: ``frame-NNNNNN.color.*``, ``.depth.*``, ``.pose.txt``, in one folder, ``seq-NN/``, ``data/``.

Depth in millimetres with 65535 for none, poses camera to world. Three calibrations:

- an ``info.txt`` of ScanNet's SensReader (12-Scenes, BundleFusion, 3RScan; `layout_scannet`);
- ``camera-intrinsics.txt``, one 3x3 matrix for both (3DMatch, Zeng et al., CVPR 2017);
- none: 7-Scenes, which publishes the depth camera's default of 585, 585, 320, 240, whose poses are those of the depth
  camera, and whose colour is not registered to depth (Shotton et al., CVPR 2013, and the dataset's page). Colour is
  taken to be a Kinect's of focal length 525, placed as another Kinect's calibration says: as ACE does
  (nianticlabs/ace, datasets/setup_7scenes.py, after LIRIS' Kinect calibration).

Open3D's and Redwood's scenes: a colour folder, ``depth/``, ``trajectory.log`` and ``camera_intrinsic.json``.

Names are those that Open3D's data classes unpack (open3d.data: RedwoodIndoorLivingRoom1 with ``colors/``,
LoungeRGBDImages, BedroomRGBDImages). Poses are camera to world: the reconstruction system writes those whose inverse
it integrates with (examples/python/reconstruction_system/integrate_scene.py). Images go by their place in natural
order, as in Open3D's reconstruction system
(examples/python/reconstruction_system/open3d_example.py, get_rgbd_file_lists); where the trajectory has more poses
than there are images, by the number in the file name.

Replica as rendered for NICE-SLAM and for Semantic-NeRF: a 4x4 matrix a line, camera to world, by image number.

NICE-SLAM: ``results/frame000000.jpg``, ``results/depth000000.png``, ``traj.txt``, and ``cam_params.json`` in the
folder or above it, else 1200x680 of 600, 600, 599.5, 339.5 and 6553.5 counts a metre (cvg/nice-slam,
configs/Replica/replica.yaml; its src/utils/datasets.py turns these poses to OpenGL's axes, so they are OpenCV's).
Semantic-NeRF: ``rgb/rgb_0.png``, ``depth/depth_0.png``, ``traj_w_c.txt``, millimetres, a field of view of 90 degrees
(as ethz-asl/autolabel, scripts/convert_replica.py, reads it).
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    DepthTable,
    Description,
    ImageFile,
    ListedView,
    PosesTable,
)
from splatctrl_cli.recording.folder.layout import (
    Layout,
    Pairs,
    by_numbers,
    described,
    given_lens,
    image_size,
    images_of,
    marked,
    own_depth_camera,
    paired_by_name,
    pinhole,
    read_json,
    read_K,
    read_pose,
)
from splatctrl_cli.recording.folder.layout_scannet import find_info, read_info
from splatctrl_cli.recording.folder.poses import read_matrix_lines, read_trajectory_log, rigid
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import MILLIMETRE, Float64

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


@dataclass(frozen=True, kw_only=True)
class _Cameras:
    """The colour camera, depth's own where it has one, the colour camera in the frame of the poses."""

    color: CameraTable
    depth: CameraTable | None = None
    T_pose_color: Float64 = field(default_factory=lambda: np.eye(4))
    depth_scale: float = MILLIMETRE
    notes: tuple[str, ...] = ()


def read_frames(folder: Path, options: SourceOptions) -> Description:
    """The folder, or all its sequences, as a description."""
    sequence = next(s for s in _SEQUENCES if next(folder.glob(f"{s}frame-*.pose.txt"), None) is not None)
    colors = _files(folder, f"{sequence}frame-*.color.*", ".color")
    depths = _files(folder, f"{sequence}frame-*.depth.*", ".depth")
    pairs = paired_by_name(folder, colors, depths, lambda name: read_pose(folder / f"{name}.pose.txt"))
    first = pairs.views[0].name
    cameras = _cameras(folder, colors[first], depths[first], options)
    return described(
        pairs.moved(lambda T: T @ cameras.T_pose_color),
        folder,
        options,
        poses=PosesTable(format="matrix-files", file=f"{sequence}frame-*.pose.txt"),
        lens=lambda _: cameras.color,
        depth_camera=cameras.depth,
        depth=DepthTable(scale=cameras.depth_scale, invalid=65535),
        notes=cameras.notes,
    )


def _files(folder: Path, pattern: str, kind: str) -> dict[str, Path]:
    """Files by their path up to `kind`, in the order of their numbers."""
    paths = sorted(folder.glob(pattern), key=lambda p: by_numbers(p.relative_to(folder).as_posix()))
    return {path.relative_to(folder).as_posix().partition(kind)[0]: path for path in paths}


def _cameras(folder: Path, color: Path, depth: Path, options: SourceOptions) -> _Cameras:
    """By what the folder says, else as 7-Scenes."""
    info = find_info(color.parent) or find_info(folder)
    if info is not None:
        calibration = read_info(info)
        lens, own = calibration.cameras(color, depth, options)
        scale = calibration.depth_scale
        return _Cameras(color=lens, depth=own, T_pose_color=calibration.T_base_color, depth_scale=scale)
    given = given_lens(options, color)
    published = (folder / "camera-intrinsics.txt", folder.parent / "camera-intrinsics.txt")
    values = next((read_K(file) for file in published if file.is_file()), DEPTH_LENS)
    if given is not None or values != DEPTH_LENS:
        return _Cameras(color=given or pinhole(values, color))
    lens = pinhole(COLOR_LENS, color)
    return _Cameras(
        color=lens,
        depth=own_depth_camera(lens, pinhole(DEPTH_LENS, depth), T_COLOR_DEPTH),
        T_pose_color=invert_transform(T_COLOR_DEPTH),
        notes=(_NOTE,),
    )


_FRAMES_DOCS = """
7-Scenes | `frame-*.pose.txt`, also in `seq-*/` | a file a frame, of the depth camera; moved to colour | 1 mm,
    65535 = none, registered to colour | depth 585, 585, 320, 240; colour 525, 525, 320, 240 with another Kinect's
    extrinsics; `--intrinsics` takes both as one

3DMatch | the same, `camera-intrinsics.txt` | a file a frame | as above, not registered | that file; 585, 585,
    320, 240 in it counts as 7-Scenes

12-Scenes, BundleFusion, 3RScan | the same, also in `data/`, `sequence/`, and `info.txt` or `_info.txt` | a file a
    frame, INF = none | `m_depthShift`; PNG or PGM, registered to colour | `m_calibrationColorIntrinsic`,
    `m_calibrationDepthIntrinsic`, extrinsics
"""


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


def is_redwood(folder: Path) -> bool:
    """Whether the folder has colour, depth and a trajectory of Open3D's form."""
    return (
        (folder / "depth").is_dir()
        and any((folder / name).is_dir() for name in COLOR_FOLDERS)
        and _trajectory(folder) is not None
    )


def read_redwood(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; depth in millimetres."""
    trajectory = _trajectory(folder)
    assert trajectory is not None
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
    return described(
        Pairs(path=trajectory, views=views, unpaired=(len(colors) - len(pairs), len(depths) - len(pairs))),
        folder,
        options,
        poses=PosesTable(format="trajectory-log", file=trajectory.relative_to(folder).as_posix()),
        lens=lambda _: _redwood_lens(folder),
    )


def _trajectory(folder: Path) -> Path | None:
    return next((path for pattern in TRAJECTORIES for path in sorted(folder.glob(pattern))), None)


def _pairs(colors: list[str], depths: list[str]) -> list[tuple[str, str]]:
    """Of the same name; else, of as many, in order; else of the same first number."""
    same = [(name, name) for name in colors if name in depths]
    if same:
        return same
    if len(colors) == len(depths):
        return list(zip(colors, depths, strict=True))
    by_number = {_number(name): name for name in depths}
    return [(name, by_number[_number(name)]) for name in colors if _number(name) in by_number]


def _number(name: str) -> int:
    found = re.search(r"\d+", name)
    return int(found[0]) if found else -1


def _redwood_lens(folder: Path) -> CameraTable:
    for file in (parent / name for parent in (folder, folder.parent) for name in INTRINSICS):
        if file.is_file():
            content = read_json(file)
            try:
                fx, _, _, _, fy, _, cx, cy, _ = (float(value) for value in content["intrinsic_matrix"])  # by columns
                return CameraTable(
                    width=int(content["width"]), height=int(content["height"]), fx=fx, fy=fy, cx=cx, cy=cy
                )
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(
                    f"{file}: expected width, height and intrinsic_matrix (9 numbers), got no {error}",
                    remedy="write it with Open3D, or give --intrinsics camera=FX,FY,CX,CY",
                ) from None
    raise InputError(
        f"{folder}: no {INTRINSICS[0]} in it or above it",
        remedy="give --intrinsics camera=FX,FY,CX,CY (Redwood's default: 525,525,319.5,239.5)",
    )


_REDWOOD_DOCS = """
Open3D, Redwood | `color/` (`colors/`, `image/`, `rgb/`), `depth/`, `trajectory.log` (`*_trajectory.log`,
    `*-traj.txt`, ...) | by order; by number where there are more poses than images | 1 mm |
    `camera_intrinsic.json` in the folder or above it, else `--intrinsics`
"""


PARAMETERS = "cam_params.json"
NICE_SLAM: Mapping[str, float] = {"fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
_FORMS = (  # trajectory, colour, depth
    ("traj.txt", "results/frame*", "results/depth*"),
    ("traj_w_c.txt", "rgb/rgb_*", "depth/depth_*"),
)


def read_replica(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description."""
    form = _form(folder)
    assert form is not None
    name, color_pattern, depth_pattern = form
    colors, depths = _by_number(folder, color_pattern), _by_number(folder, depth_pattern)
    poses = read_matrix_lines(folder / name)
    pairs = paired_by_name(
        folder / name,
        colors,
        depths,
        lambda number: poses[number] if number < len(poses) else None,
        lambda number: colors[number].stem,
    )
    lens, scale = _replica_lens(folder, name, pairs.views[0].color, options)
    return described(
        pairs,
        folder,
        options,
        poses=PosesTable(format="matrix-lines", file=name),
        lens=lambda _: lens,
        depth=DepthTable(scale=scale),
    )


def _form(folder: Path) -> tuple[str, str, str] | None:
    return next((f for f in _FORMS if (folder / f[0]).is_file() and next(folder.glob(f[1]), None) is not None), None)


def _by_number(folder: Path, pattern: str) -> dict[int, Path]:
    found = sorted(folder.glob(pattern), key=lambda path: by_numbers(path.name))
    return {numbers[-1]: path for path in found if (numbers := by_numbers(path.stem)[0])}


def _replica_lens(
    folder: Path, trajectory: str, image: ImageFile, options: SourceOptions
) -> tuple[CameraTable, float]:
    """The lens, and metres per count."""
    given = given_lens(options, image)
    width, height = image_size(image)
    if trajectory == _FORMS[1][0]:
        square = (width / 2, width / 2, (width - 1) / 2, (height - 1) / 2)
        return given or pinhole(square, image), MILLIMETRE
    file = next((path for parent in (folder, folder.parent) if (path := parent / PARAMETERS).is_file()), None)
    content: Any = dict(NICE_SLAM) if file is None else read_json(file)
    try:
        values = content if file is None else content["camera"]
        lens = tuple(float(values[key]) for key in ("fx", "fy", "cx", "cy"))
        scale = 1.0 / float(values["scale"])
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(
            f"{file}: expected camera.fx, fy, cx, cy, scale, got no usable {error}", remedy="copy the file again"
        ) from None
    if file is None and given is None and (width, height) != (1200, 680):
        raise InputError(
            f"{folder}: no {PARAMETERS} in it or above it, and images of {width}x{height} instead of 1200x680",
            remedy="give --intrinsics camera=FX,FY,CX,CY and --depth-scale",
        )
    return given or pinhole(lens, image), scale


_REPLICA_DOCS = """
Replica of NICE-SLAM | `traj.txt`, `results/frame*`, `results/depth*` | a matrix a line, by number | `scale` of
    `cam_params.json`, else 1/6553.5 m | `cam_params.json`, else 600, 600, 599.5, 339.5

Replica of Semantic-NeRF | `traj_w_c.txt`, `rgb/rgb_*`, `depth/depth_*` | a matrix a line, by number | 1 mm | a
    field of view of 90°
"""

ENTRIES = (
    Layout(
        name="7-Scenes",
        order=3,
        matches=marked(*(f"{sequence}frame-*.pose.txt" for sequence in _SEQUENCES)),
        read=read_frames,
        docs=_FRAMES_DOCS,
    ),
    Layout(name="Open3D scene", order=9, matches=is_redwood, read=read_redwood, docs=_REDWOOD_DOCS),
    Layout(
        name="Replica",
        order=6,
        matches=lambda folder: _form(folder) is not None,
        read=read_replica,
        docs=_REPLICA_DOCS,
    ),
)
