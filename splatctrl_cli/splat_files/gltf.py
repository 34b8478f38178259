"""Gaussians as glTF 2.0 in one binary file (``.glb``), with the extension KHR_gaussian_splatting.

One primitive of points whose attributes are float32: centre, rotation (x y z w), sigmas (linear), opacity, and every
harmonic's coefficient of red, green, blue; COLOR_0 holds the colour for readers that know points alone. The values
are in world as they are; glTF's up is y, so the node that holds them turns a world whose z is up.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import GaussianSet, Label
from splatctrl_cli.splat_files.gaussian_ply import check_gaussians
from splatctrl_cli.splat_files.glb import Accessors, GlbWriter, read_glb
from splatctrl_cli.splat_files.splat_format import SplatFormat
from splatctrl_cli.splat_files.splat_values import SH_C0, refuse, unit_quaternions

EXTENSION = "KHR_gaussian_splatting"
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))
Z_UP_TO_Y_UP = [-float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5))]  # x y z w: a quarter turn back about x
PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}


def write_glb(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    """Write `gaussians`; `comments` go in the asset's extras. Same input, same bytes.

    Labels are the attribute ``_LABEL``, where some Gaussian is no object.
    Raises InputError for a value that is no Gaussian's, naming its index.
    """
    check_gaussians("Gaussians to write", gaussians)
    writer = GlbWriter()
    attributes = {"POSITION": writer.add(gaussians.centers, with_range=True)}
    attributes["COLOR_0"] = writer.add(_point_colors(gaussians))
    attributes[ROTATION] = writer.add(np.roll(gaussians.quats_wxyz, -1, axis=1))
    attributes[SCALE] = writer.add(gaussians.scales)
    attributes[OPACITY] = writer.add(gaussians.opacities[:, None])
    for index in range(gaussians.harmonics.shape[1]):
        attributes[coefficient_name(index)] = writer.add(gaussians.harmonics[:, index])
    if (gaussians.labels != Label.OBJECT).any():
        attributes["_LABEL"] = writer.add(gaussians.labels[:, None].astype(np.float32))
    primitive = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: PROPERTIES}}
    document = {
        "asset": {"version": "2.0", "generator": "splatctrl", "extras": {"frame": "world", **comments}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "splats", "mesh": 0, "rotation": Z_UP_TO_Y_UP}],
        "meshes": [{"primitives": [primitive]}],
    }
    writer.write(path, document)


def read_gltf(path: Path) -> tuple[GaussianSet, dict[str, str]]:
    """The Gaussians of a ``.glb`` file in the axes of their own mesh (a node's transform is not applied), and extras.

    Raises InputError for a file that is not whole, has not exactly one primitive of Gaussians, or packs them.
    """
    document, binary = read_glb(path)
    primitive = _primitive(path, document)
    accessors = Accessors(path, document, binary)
    try:
        gaussians = _gaussians(path, primitive["attributes"], accessors)
        extras = document["asset"].get("extras", {})
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: glTF not understood: {type(error).__name__}: {error}") from None
    check_gaussians(str(path), gaussians)
    return gaussians, {key: str(value) for key, value in extras.items()}


def coefficient_name(index: int) -> str:
    """The attribute of coefficient `index` of the harmonics, counted through all degrees."""
    degree = int(np.sqrt(index))
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index - degree * degree}"


def _point_colors(gaussians: GaussianSet) -> NDArray[np.uint8]:
    """(N, 4) red, green, blue, opacity of 0 to 255: the colour that a plain point cloud shows."""
    colors = np.clip(0.5 + SH_C0 * gaussians.harmonics[:, 0].astype(np.float64), 0.0, 1.0)
    return np.rint(255.0 * np.column_stack([colors, gaussians.opacities])).astype(np.uint8)


def _primitive(path: Path, document: Mapping[str, Any]) -> dict[str, Any]:
    """The one primitive that is Gaussians."""
    try:
        primitives = [primitive for mesh in document.get("meshes", []) for primitive in mesh["primitives"]]
        found = [primitive for primitive in primitives if EXTENSION in primitive.get("extensions", {})]
        names = [name for primitive in found for name in primitive["extensions"][EXTENSION].get("extensions", {})]
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: glTF not understood: {type(error).__name__}: {error}") from None
    if len(found) != 1:
        raise InputError(f"{path}: expected one primitive with {EXTENSION}, got {len(found)} of {len(primitives)}")
    if names:
        raise InputError(f"{path}: its Gaussians are packed by {names[0]}, expected plain attributes")
    primitive: dict[str, Any] = found[0]
    kernel = primitive["extensions"][EXTENSION].get("kernel")
    if kernel != PROPERTIES["kernel"]:
        raise InputError(f"{path}: kernel of its Gaussians: expected {PROPERTIES['kernel']}, got {kernel}")
    return primitive


def _gaussians(path: Path, attributes: Mapping[str, int], accessors: Accessors) -> GaussianSet:
    required = ("POSITION", ROTATION, SCALE, OPACITY, coefficient_name(0))
    missing = [name for name in required if name not in attributes]
    if missing:
        raise InputError(f"{path}: its Gaussians have no {', '.join(missing)} (they have {', '.join(attributes)})")
    num = 1
    while coefficient_name(num) in attributes:
        num += 1
    if num not in (1, 4, 9, 16):
        raise InputError(f"{path}: harmonics: expected 1, 4, 9 or 16 coefficients, got {num}")
    centers, scales = accessors.table(attributes["POSITION"], 3), accessors.table(attributes[SCALE], 3)
    if (scales < 0).any():
        where = np.flatnonzero((scales < 0).any(axis=1))[0]
        raise InputError(
            f"{path}: splat {where}: {SCALE}: expected no negative sigma, got {scales[where]}",
            remedy="drafts of the extension held logarithms there: write it again with a newer tool",
        )
    labels = accessors.table(attributes["_LABEL"], 1)[:, 0] if "_LABEL" in attributes else np.zeros(len(centers))
    refuse(str(path), "_LABEL", labels, (labels < 0) | (labels > 255) | (labels % 1 != 0), "a whole number 0 to 255")
    return GaussianSet(
        centers=centers,
        scales=scales,
        quats_wxyz=unit_quaternions(str(path), np.roll(accessors.table(attributes[ROTATION], 4), 1, axis=1)),
        opacities=accessors.table(attributes[OPACITY], 1)[:, 0],
        harmonics=np.stack([accessors.table(attributes[coefficient_name(k)], 3) for k in range(num)], axis=1),
        labels=labels.astype(np.uint8),
    )


_DOCS = """
`.glb` | glTF 2.0 with
    [KHR_gaussian_splatting](https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting)
    | float32 | density
"""
ENTRIES = (
    SplatFormat(
        name="glTF with KHR_gaussian_splatting", order=3, suffix=".glb", write=write_glb, read=read_gltf, docs=_DOCS
    ),
)
