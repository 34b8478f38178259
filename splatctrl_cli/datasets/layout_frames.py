"""7-Scenes and its kin: ``frame-NNNNNN.color.*``, ``.depth.*``, ``.pose.txt``, in one folder, ``seq-NN/``, ``data/``.

Depth in millimetres with 65535 for none, poses camera to world. Three calibrations:

- an ``info.txt`` of ScanNet's SensReader (12-Scenes, BundleFusion, 3RScan; `layout_sens`);
- ``camera-intrinsics.txt``, one 3x3 matrix for both (3DMatch, Zeng et al., CVPR 2017);
- none: 7-Scenes, which publishes the depth camera's default of 585, 585, 320, 240, whose poses are those of the depth
  camera, and whose colour is not registered to depth (Shotton et al., CVPR 2013, and the dataset's page). Colour is
  taken to be a Kinect's of focal length 525, placed as another Kinect's calibration says: as ACE does
  (nianticlabs/ace, datasets/setup_7scenes.py, after LIRIS' Kinect calibration).
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatctrl_cli.datasets.folder_description import CameraTable, DepthTable, Description, PosesTable
from splatctrl_cli.datasets.layout import (
    Layout,
    by_numbers,
    described,
    given_lens,
    own_depth_camera,
    paired_by_name,
    pinhole,
    read_K,
    read_pose,
)
from splatctrl_cli.datasets.layout_scannet import find_info, read_info
from splatctrl_cli.datasets.poses import rigid
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.logs.source_options import SourceOptions
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


def matches(folder: Path) -> bool:
    """Whether the folder, or a sequence in it, has frames with a pose each."""
    return any(next(folder.glob(f"{sequence}frame-*.pose.txt"), None) is not None for sequence in _SEQUENCES)


def read(folder: Path, options: SourceOptions) -> Description:
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


_DOCS = """
7-Scenes | `frame-*.pose.txt`, also in `seq-*/` | a file a frame, of the depth camera; moved to colour | 1 mm,
    65535 = none, registered to colour | depth 585, 585, 320, 240; colour 525, 525, 320, 240 with another Kinect's
    extrinsics; `--intrinsics` takes both as one

3DMatch | the same, `camera-intrinsics.txt` | a file a frame | as above, not registered | that file; 585, 585,
    320, 240 in it counts as 7-Scenes

12-Scenes, BundleFusion, 3RScan | the same, also in `data/`, `sequence/`, and `info.txt` or `_info.txt` | a file a
    frame, INF = none | `m_depthShift`; PNG or PGM, registered to colour | `m_calibrationColorIntrinsic`,
    `m_calibrationDepthIntrinsic`, extrinsics
"""
ENTRIES = (Layout(name="7-Scenes", order=3, matches=matches, read=read, docs=_DOCS),)
