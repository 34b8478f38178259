"""ICL-NUIM in its TUM-compatible form: ``rgb/N.png``, ``depth/N.png`` and a ``*.gt.freiburg``, all by the number N.

Depth counts 1/5000 m along the optical axis. The renderer's camera is left-handed, which its page writes as a
negative focal length (481.20, -480.00, 319.50, 239.50): y points up, in the camera and in the world. Both are
mirrored here, so that poses stay rigid and fy is positive, as in theNded/MeshHashing (src/io/config_manager.cc). The
trajectory begins with image 1; image 0 has no pose.
"""

from pathlib import Path

import numpy as np

from splatctrl_cli.datasets.folder_description import DepthTable, Description, ListedView, PosesTable
from splatctrl_cli.datasets.layout import Layout, described, given_lens, images_of, pinhole
from splatctrl_cli.datasets.layout_tum import SCALE
from splatctrl_cli.datasets.poses import read_tum
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.records import Float64

LENS = (481.2, 480.0, 319.5, 239.5)
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_TRAJECTORY = "*.gt.freiburg"


def matches(folder: Path) -> bool:
    """Whether the folder is such a sequence."""
    has_images = all((folder / name).is_dir() for name in ("rgb", "depth"))
    return has_images and next(folder.glob(_TRAJECTORY), None) is not None


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description, right-handed."""
    colors, depths = images_of(folder / "rgb"), images_of(folder / "depth")
    file = sorted(folder.glob(_TRAJECTORY))[0]
    poses = {_number(name): MIRROR @ T @ MIRROR for name, T in read_tum(file).items()}
    names = [name for name in colors if name in depths]
    views = [
        ListedView(name=name, color=colors[name], depth=depths[name], matrix=_pose(poses, name)) for name in names
    ]
    return described(
        file,
        folder,
        views,
        poses=PosesTable(format="tum", file=file.name),
        camera=given_lens(options, views[0].color) or pinhole(LENS, views[0].color) if views else None,
        depth=DepthTable(scale=SCALE),
        unpaired=(len(colors) - len(views), len(depths) - len(views)),
    )


def _pose(poses: dict[int, Float64], name: str) -> Float64 | None:
    return poses.get(_number(name))


def _number(name: str) -> int:
    """The number that a stem or a stamp is, -1 where it is none."""
    try:
        return int(float(name))
    except (ValueError, OverflowError):
        return -1


_DOCS = """
ICL-NUIM, TUM-compatible | `rgb/`, `depth/`, `*.gt.freiburg` | by number; mirrored to right-handed | 1/5000 m |
    481.2, 480, 319.5, 239.5
"""
ENTRIES = (Layout(name="ICL-NUIM", order=5, matches=matches, read=read, docs=_DOCS),)
