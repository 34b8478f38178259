"""Replica as rendered for NICE-SLAM and for Semantic-NeRF: a 4x4 matrix a line, camera to world, by image number.

NICE-SLAM: ``results/frame000000.jpg``, ``results/depth000000.png``, ``traj.txt``, and ``cam_params.json`` in the
folder or above it, else 1200x680 of 600, 600, 599.5, 339.5 and 6553.5 counts a metre (cvg/nice-slam,
configs/Replica/replica.yaml; its src/utils/datasets.py turns these poses to OpenGL's axes, so they are OpenCV's).
Semantic-NeRF: ``rgb/rgb_0.png``, ``depth/depth_0.png``, ``traj_w_c.txt``, millimetres, a field of view of 90 degrees
(as ethz-asl/autolabel, scripts/convert_replica.py, reads it).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatctrl_cli.datasets.folder_description import CameraTable, DepthTable, Description, ImageFile, PosesTable
from splatctrl_cli.datasets.layout import (
    Layout,
    by_numbers,
    described,
    given_lens,
    image_size,
    paired_by_name,
    pinhole,
    read_json,
)
from splatctrl_cli.datasets.poses import read_matrix_lines
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import MILLIMETRE

PARAMETERS = "cam_params.json"
NICE_SLAM: Mapping[str, float] = {"fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
_FORMS = (  # trajectory, colour, depth
    ("traj.txt", "results/frame*", "results/depth*"),
    ("traj_w_c.txt", "rgb/rgb_*", "depth/depth_*"),
)


def matches(folder: Path) -> bool:
    """Whether the folder has the trajectory and images of one of both."""
    return _form(folder) is not None


def read(folder: Path, options: SourceOptions) -> Description:
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
    lens, scale = _lens(folder, name, pairs.views[0].color, options)
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


def _lens(folder: Path, trajectory: str, image: ImageFile, options: SourceOptions) -> tuple[CameraTable, float]:
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


_DOCS = """
Replica of NICE-SLAM | `traj.txt`, `results/frame*`, `results/depth*` | a matrix a line, by number | `scale` of
    `cam_params.json`, else 1/6553.5 m | `cam_params.json`, else 600, 600, 599.5, 339.5

Replica of Semantic-NeRF | `traj_w_c.txt`, `rgb/rgb_*`, `depth/depth_*` | a matrix a line, by number | 1 mm | a
    field of view of 90°
"""
ENTRIES = (Layout(name="Replica", order=6, matches=matches, read=read, docs=_DOCS),)
