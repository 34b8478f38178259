"""nerfstudio's and instant-ngp's ``transforms.json`` with depth: lens, files and pose per frame.

Fields, defaults and axes (OpenGL): nerfstudio's documentation ("Data conventions"),
nerfstudio/data/dataparsers/nerfstudio_dataparser.py and data/utils/data_utils.py. Masks are 0 on invalid pixels;
depth of another size is resized by nearest pixels; ``applied_scale`` is undone. instant-ngp has ``depth_path``,
``integer_depth_scale`` [m per count], ``camera_angle_x``, ``is_fisheye``; its default principal point is the image's
centre (NVlabs/instant-ngp, scripts/nerfcapture2nerf.py, and src/nerf_loader.cu).
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.recording.folder.folder_description import CameraTable, Description, ListedView, PosesTable
from splatctrl_cli.recording.folder.layout import Layout, add_lens, find_marks, image_size
from splatctrl_cli.recording.folder.poses import read_nerfstudio
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64

FILES = ("transforms.json", "transforms_train.json")  # the second is Blender's of NeRF, which has no depth
_RADIAL = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")  # nerfstudio's CAMERA_MODEL_TO_TYPE
_MODELS = {**dict.fromkeys(_RADIAL, "plumb_bob"), "OPENCV_FISHEYE": "equidistant"}
_ALL = ("k1", "k2", "p1", "p2", "k3", "k4")
_COEFFICIENTS = {
    **dict.fromkeys(_RADIAL[:2], ()),
    **dict.fromkeys(_RADIAL[2:], _ALL[:5]),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
SUPPLY = "add depth_file_path to each frame (16-bit PNG in mm, or .npy in m), or describe the files in a .toml"


def read(folder: Path, options: SourceOptions) -> Description:
    """Describe the folder; depth defaults to millimetres."""
    options.refuse(("intrinsics",), "a folder with transforms.json", folder)
    file = next(name for name in FILES if (folder / name).is_file())
    return fill_transforms(
        Description(path=folder / file, root=folder, poses=PosesTable(format="nerfstudio", file=file, axes="opengl"))
    )


def fill_transforms(description: Description) -> Description:
    table = description.poses
    is_whole = bool(description.listed or (description.camera and description.frames))
    if is_whole or table is None or table.format != "nerfstudio":
        return description
    path = description.root / table.file
    content, matrices = read_nerfstudio(path)
    lenses: list[CameraTable] = []
    views = [_view(content, entry, path, lenses, description, matrices) for entry in content["frames"]]
    refuse_if(not views, f"{path}: no frames", remedy="give a transforms.json with frames")
    bare = [view.name for view in views if view.depth is None]
    refuse_if(
        0 < len(bare) < len(views),
        f"{path}: {''.join(bare[:1])}: depth_file_path is missing ({len(bare)} of {len(views)} frames)",
        remedy="add it, or leave the frame out",
    )
    if description.frames is not None:
        refuse_if(
            len(lenses) > 1,
            f"{path}: {len(lenses)} different sets of intrinsics beside [frames]",
            remedy="leave [frames] out, or give [camera]",
        )
        return replace(description, camera=views[0].camera)
    stems = [Path(view.name).stem for view in views]
    is_short = len(set(stems)) == len(stems)  # else the path without suffix
    names = stems if is_short else [str(Path(view.name).with_suffix("")) for view in views]
    return replace(
        description,
        camera=views[0].camera,
        listed=tuple(
            sorted((replace(view, name=name) for view, name in zip(views, names, strict=True)), key=lambda v: v.name)
        ),
        is_depth_resized=True,
        supply=SUPPLY,
    )


def _view(
    content: dict[str, Any],
    entry: dict[str, Any],
    path: Path,
    lenses: list[CameraTable],
    description: Description,
    matrices: dict[str, Float64],
) -> ListedView:
    name, values = str(entry["file_path"]), {**content, **entry}
    color = _image(path.parent / name.replace("\\", "/"))
    depth = _only(entry, ("depth_file_path", "depth_path"), path)
    scale = _only(values, ("depth_unit_scale_factor", "integer_depth_scale"), path)
    mask = entry.get("mask_path")
    with refuse_faults(
        lambda error: f"{path}: {name}: expected numbers, got {error}",
        TypeError,
        ValueError,
        ZeroDivisionError,
        remedy="correct the file",
    ):
        applied = float(content.get("applied_scale", 1.0))
        matrix = matrices[name].copy()
        matrix[:3, 3] *= 1.0 / applied
        unit = None if scale is None else float(scale)
    return ListedView(
        name=name,
        color=color,
        depth=None if depth is None else path.parent / str(depth).replace("\\", "/"),
        matrix=matrix,
        camera=description.camera or add_lens(lenses, _camera(values, color, path), str(path)),
        depth_scale=unit,
        valid=None if not mask else path.parent / str(mask).replace("\\", "/"),
    )


def _only(values: dict[str, Any], keys: tuple[str, ...], path: Path) -> Any:
    present = {key: values[key] for key in keys if values.get(key) not in (None, "")}
    both = " and ".join(f"{key} = {value}" for key, value in present.items())
    refuse_if(len(set(present.values())) > 1, f"{path}: {both} differ", remedy="leave one of them out")
    return next(iter(present.values()), None)


def _image(path: Path) -> Path:
    """An image whose name may omit `.png` or `.jpg`, as in Blender's scenes."""
    ends = () if path.suffix else (".png", ".jpg")
    return next((file for end in ends if (file := path.with_name(path.name + end)).is_file()), path)


def _camera(values: dict[str, Any], image: Path, path: Path) -> CameraTable:
    model = str(values.get("camera_model") or ("OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV"))
    refuse_if(
        model not in _MODELS,
        f"{path}: camera_model: expected one of {', '.join(_MODELS)}, got {model!r}",
        remedy="undistort the images",
    )
    refuse_if(
        "is_fisheye" in values and bool(values["is_fisheye"]) != (model == "OPENCV_FISHEYE"),
        f"{path}: camera_model is {model}, but is_fisheye is {values.get('is_fisheye')}",
        remedy="correct one of them",
    )
    with refuse_faults(
        lambda error: f"{path}: no usable {error} in the intrinsics",
        KeyError,
        TypeError,
        ValueError,
        ZeroDivisionError,
        remedy="give [camera] and [frames] in a description",
    ):
        distortion = [float(values.get(key, 0.0)) for key in _COEFFICIENTS[model]]
        further = sorted(key for key in _ALL if key not in _COEFFICIENTS[model] and float(values.get(key, 0.0)))
        if further:
            raise InputError(
                f"{path}: camera_model {model}: expected no {further[0]}, got {values[further[0]]}",
                remedy="correct the model, or undistort the images",
            )
        width, height = (int(values["w"]), int(values["h"])) if {"w", "h"} <= values.keys() else image_size(image)
        fx = float(values["fl_x"]) if "fl_x" in values else width / 2 / math.tan(float(values["camera_angle_x"]) / 2)
        return CameraTable(
            width=width,
            height=height,
            fx=fx,
            fy=float(values.get("fl_y", fx)),
            cx=float(values.get("cx", width / 2)),
            cy=float(values.get("cy", height / 2)),
            pixel_center=0.5,  # nerfstudio's convention
            distortion=distortion,
            distortion_model=_MODELS[model],
        )


ENTRIES = (
    Layout(
        name="nerfstudio",
        order=4,
        matches=find_marks(*FILES),
        read=read,
        docs="""
nerfstudio, instant-ngp, Blender | `transforms.json` or `transforms_train.json`, `depth_file_path` or `depth_path` |
    `transform_matrix`, without `applied_scale` | 1 mm, or `integer_depth_scale`; `.npy` | of the file or each
    frame; `mask_path` leaves pixels out
""",
    ),
)
