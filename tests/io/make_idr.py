"""Writes a scan in the layout of IDR and NeuS, as the converters of those projects leave one."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.io.dtu import DtuView
from splatctrl_cli.io.dtu_source import shrunk
from splatctrl_cli.io.pfm import write_pfm
from splatctrl_cli.records import Float64

RADIUS = 300.0  # [mm] of the sphere around the object
CENTER = (0.0, 0.0, 600.0)  # [mm]


def projection(view: DtuView, scale: float = 1.0) -> Float64:
    """World points [mm] to pixels, (4, 4), times `scale`."""
    k = view.intrinsics
    T_camera_world = invert_transform(view.T_world_camera)
    T_camera_world[:3, 3] *= 1000.0
    K = np.array([[k.fx, 0.0, k.cx, 0.0], [0.0, k.fy, k.cy, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    P = K @ T_camera_world
    P[:3] *= scale
    return P


def half_size(view: DtuView) -> DtuView:
    """The view at half the size, with the middle as its mask, for speed."""
    k = view.intrinsics
    mask = np.zeros((k.height // 2, k.width // 2), np.bool_)
    mask[20:-20, 30:-30] = True
    return replace(shrunk(view, 2), mask=mask)


def write_idr(
    root: Path, scan: str, views: Sequence[DtuView], *, with_depth: bool = True, scale: float = 1.0
) -> Path:
    """The folder of the scan, with a mask for every view that has one."""
    folder = root / scan
    (folder / "image").mkdir(parents=True)
    normalise = np.diag([RADIUS, RADIUS, RADIUS, 1.0])
    normalise[:3, 3] = CENTER
    matrices = {}
    for number, view in enumerate(views):
        matrices |= {f"world_mat_{number}": projection(view, scale), f"scale_mat_{number}": normalise}
        _png(folder / "image" / f"{number:06d}.png", view.color[:, :, ::-1])
        if view.mask is not None:
            _png(folder / "mask" / f"{number:03d}.png", np.where(view.mask, 255, 0).astype(np.uint8))
        if with_depth:
            (folder / "depth").mkdir(exist_ok=True)
            write_pfm(folder / "depth" / f"depth_map_{number:04d}.pfm", view.depth * np.float32(1000.0))
    np.savez(folder / "cameras_sphere.npz", **matrices)
    return folder


def _png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes())
