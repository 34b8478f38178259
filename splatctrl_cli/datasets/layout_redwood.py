"""Open3D's and Redwood's scenes: a colour folder, ``depth/``, ``trajectory.log`` and ``camera_intrinsic.json``.

Names are those that Open3D's data classes unpack (open3d.data: RedwoodIndoorLivingRoom1 with ``colors/``,
LoungeRGBDImages, BedroomRGBDImages). Poses are camera to world: the reconstruction system writes those whose inverse
it integrates with (examples/python/reconstruction_system/integrate_scene.py). Images go by their place in natural
order, as in Open3D's reconstruction system
(examples/python/reconstruction_system/open3d_example.py, get_rgbd_file_lists); where the trajectory has more poses
than there are images, by the number in the file name.
"""

import re
from pathlib import Path

from splatctrl_cli.datasets.folder_description import CameraTable, Description, ListedView, PosesTable
from splatctrl_cli.datasets.layout import Layout, Pairs, described, images_of, read_json
from splatctrl_cli.datasets.poses import read_trajectory_log
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions

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


def matches(folder: Path) -> bool:
    """Whether the folder has colour, depth and a trajectory of Open3D's form."""
    return (
        (folder / "depth").is_dir()
        and any((folder / name).is_dir() for name in COLOR_FOLDERS)
        and _trajectory(folder) is not None
    )


def read(folder: Path, options: SourceOptions) -> Description:
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
        lens=lambda _: _lens(folder),
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


def _lens(folder: Path) -> CameraTable:
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


_DOCS = """
Open3D, Redwood | `color/` (`colors/`, `image/`, `rgb/`), `depth/`, `trajectory.log` (`*_trajectory.log`,
    `*-traj.txt`, ...) | by order; by number where there are more poses than images | 1 mm |
    `camera_intrinsic.json` in the folder or above it, else `--intrinsics`
"""
ENTRIES = (Layout(name="Open3D scene", order=9, matches=matches, read=read, docs=_DOCS),)
