"""ScanNet as its SensReader exports it: ``color/``, ``depth/``, ``pose/`` and ``intrinsic/``.

Numbers in the names, depth in millimetres in a camera of its own, poses camera to world with -inf where tracking was
lost (SensReader/python/SensorData.py). The subset scannet_frames_25k has ``intrinsics_color.txt`` and
``intrinsics_depth.txt`` instead of the last folder.
"""

from pathlib import Path

from splatctrl_cli.datasets.folder_description import DepthTable, Description, ListedView, PosesTable
from splatctrl_cli.datasets.layout import Layout, described, images_of, pose_or_none
from splatctrl_cli.datasets.layout_sens import read_text_files
from splatctrl_cli.datasets.poses import read_matrix_file
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.records import Float64


def matches(folder: Path) -> bool:
    """Whether the folder is such an export."""
    has_lenses = (folder / "intrinsic").is_dir() or (folder / "intrinsics_color.txt").is_file()
    return has_lenses and all((folder / name).is_dir() for name in ("color", "depth", "pose"))


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; depth is registered to colour unless both are the same camera."""
    colors, depths = images_of(folder / "color"), images_of(folder / "depth")
    calibration = read_text_files(folder)
    views = [
        ListedView(
            name=name,
            color=colors[name],
            depth=depths[name],
            matrix=_pose(folder / "pose" / f"{name}.txt", calibration.T_base_color),
        )
        for name in colors
        if name in depths
    ]
    color_lens = depth_camera = None
    if views:
        color_lens, depth_camera = calibration.cameras(views[0].color, views[0].depth, options)
    return described(
        folder,
        folder,
        views,
        poses=PosesTable(format="matrix-files", file="pose/*.txt"),
        camera=color_lens,
        depth_camera=depth_camera,
        depth=DepthTable(scale=calibration.depth_scale),
        unpaired=(len(colors) - len(views), len(depths) - len(views)),
    )


def _pose(path: Path, T_base_color: Float64) -> Float64 | None:
    """T_world_color, None where the frame has no pose."""
    matrix = pose_or_none(read_matrix_file(path)) if path.is_file() else None
    return None if matrix is None else matrix @ T_base_color


_DOCS = """
ScanNet export | `color/`, `depth/`, `pose/`, `intrinsic/` (or `intrinsics_color.txt`) | a file a frame, -inf =
    none | 1 mm, registered to colour | `intrinsic_color.txt`, `intrinsic_depth.txt`, extrinsics
"""
ENTRIES = (Layout(name="ScanNet export", order=2, matches=matches, read=read, docs=_DOCS),)
