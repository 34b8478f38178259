"""ScanNet as its SensReader exports it, and the calibration that its sensor files (.sens) carry.

The export: ``color/``, ``depth/``, ``pose/`` and ``intrinsic/``; numbers in the names, depth in millimetres in a
camera of its own, poses camera to world with -inf where tracking was lost (SensReader/python/SensorData.py). The
subset scannet_frames_25k has ``intrinsics_color.txt`` and ``intrinsics_depth.txt`` instead of the last folder.

The calibration, in those files or in the ``info.txt`` beside the frames: fields and their meaning are those of
ScanNet's SensReader (c++/src/sensorData.h): intrinsics 4x4; an extrinsic maps its camera to the rig's base frame,
which is usually the colour camera; depthShift is counts per metre. 12-Scenes, BundleFusion and 3RScan publish it too.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.datasets.folder_description import CameraTable, DepthTable, Description, ImageFile, PosesTable
from splatctrl_cli.datasets.layout import (
    Layout,
    described,
    given_lens,
    images_of,
    own_depth_camera,
    paired_by_name,
    pinhole,
    read_pose,
)
from splatctrl_cli.datasets.poses import read_matrix_file, rigid
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import MILLIMETRE, Float64

INFO_NAMES = ("_info.txt", "info.txt")


@dataclass(frozen=True, kw_only=True)
class SensCalibration:
    """Lenses of both cameras (4, 4) [px], where they are in the rig's base, and metres per count of depth."""

    color: Float64
    depth: Float64
    T_base_color: Float64
    T_base_depth: Float64
    depth_scale: float = MILLIMETRE
    where: str = ""

    def cameras(
        self, color_image: ImageFile, depth_image: ImageFile, options: SourceOptions
    ) -> tuple[CameraTable, CameraTable | None]:
        """Colour and depth camera, of the sizes of two images; no depth camera where both are one.

        Raises InputError where a lens cannot be that of its image.
        """
        color = given_lens(options, color_image) or _lens(self.color, color_image, f"{self.where} (colour)")
        depth = _lens(self.depth, depth_image, f"{self.where} (depth)")
        return color, own_depth_camera(color, depth, invert_transform(self.T_base_color) @ self.T_base_depth)


def read_text_files(folder: Path) -> SensCalibration:
    """From ``intrinsic/intrinsic_color.txt`` and its kin (SensorData.py), or ``intrinsics_color.txt`` beside the
    images (scannet_frames_25k), which has no extrinsics.
    """
    inner = folder / "intrinsic"
    if inner.is_dir():
        names = ("intrinsic_color", "intrinsic_depth", "extrinsic_color", "extrinsic_depth")
    else:
        inner, names = folder, ("intrinsics_color", "intrinsics_depth", "extrinsics_color", "extrinsics_depth")
    files = [inner / f"{name}.txt" for name in names]
    extrinsics = [rigid(read_matrix_file(file), str(file)) if file.is_file() else np.eye(4) for file in files[2:]]
    return SensCalibration(
        color=read_matrix_file(files[0]),
        depth=read_matrix_file(files[1]),
        T_base_color=extrinsics[0],
        T_base_depth=extrinsics[1],
        where=str(inner),
    )


def find_info(folder: Path) -> Path | None:
    """The ``info.txt`` of a folder or of one above it."""
    return next((path for name in INFO_NAMES for f in (folder, folder.parent) if (path := f / name).is_file()), None)


def read_info(path: Path) -> SensCalibration:
    """From ``NAME = VALUES`` lines. Raises InputError where one that is needed is not there."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    values = {name.strip(): text.split() for name, _, text in (line.partition("=") for line in lines)}

    def matrix(name: str, default: Float64 | None = None) -> Float64:
        if name not in values and default is not None:
            return default
        return np.array([float(word) for word in values[name]]).reshape(4, 4)

    try:
        return SensCalibration(
            color=matrix("m_calibrationColorIntrinsic"),
            depth=matrix("m_calibrationDepthIntrinsic"),
            T_base_color=rigid(
                matrix("m_calibrationColorExtrinsic", np.eye(4)), f"{path}: m_calibrationColorExtrinsic"
            ),
            T_base_depth=rigid(
                matrix("m_calibrationDepthExtrinsic", np.eye(4)), f"{path}: m_calibrationDepthExtrinsic"
            ),
            depth_scale=1.0 / float(values["m_depthShift"][0]) if "m_depthShift" in values else MILLIMETRE,
            where=str(path),
        )
    except (KeyError, ValueError, IndexError, ZeroDivisionError) as error:
        raise InputError(
            f"{path}: expected m_calibrationColorIntrinsic and m_calibrationDepthIntrinsic of 16 numbers each, got no"
            f" usable {error}",
            remedy="copy the file again, or give --intrinsics camera=FX,FY,CX,CY",
        ) from None


def _lens(K: Float64, image: ImageFile, where: str) -> CameraTable:
    lens = pinhole((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), image)
    if abs(2 * lens.cx - lens.width) > 0.25 * lens.width:
        raise InputError(
            f"{where}: cx {lens.cx:g} is not near the middle of {image.name}, {lens.width} columns wide",
            remedy="scale the intrinsics with the images, or give --intrinsics camera=FX,FY,CX,CY",
        )
    return lens


def matches(folder: Path) -> bool:
    """Whether the folder is such an export."""
    has_lenses = (folder / "intrinsic").is_dir() or (folder / "intrinsics_color.txt").is_file()
    return has_lenses and all((folder / name).is_dir() for name in ("color", "depth", "pose"))


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description; depth is registered to colour unless both are the same camera."""
    colors, depths = images_of(folder / "color"), images_of(folder / "depth")
    calibration = read_text_files(folder)
    pairs = paired_by_name(folder, colors, depths, lambda name: read_pose(folder / "pose" / f"{name}.txt"))
    first = pairs.views[0]
    lens, depth_camera = calibration.cameras(first.color, depths[first.name], options)
    return described(
        pairs.moved(lambda T: T @ calibration.T_base_color),
        folder,
        options,
        poses=PosesTable(format="matrix-files", file="pose/*.txt"),
        lens=lambda _: lens,
        depth_camera=depth_camera,
        depth=DepthTable(scale=calibration.depth_scale),
    )


_DOCS = """
ScanNet export | `color/`, `depth/`, `pose/`, `intrinsic/` (or `intrinsics_color.txt`) | a file a frame, -inf =
    none | 1 mm, registered to colour | `intrinsic_color.txt`, `intrinsic_depth.txt`, extrinsics
"""


ENTRIES = (Layout(name="ScanNet export", order=2, matches=matches, read=read, docs=_DOCS),)
