"""Gaussians as OpenUSD particle fields (UsdVol ParticleField3DGaussianSplat, OpenUSD 26.3 and later), in world.

Sigmas and opacities are linear; harmonics are ordered by Gaussian, then coefficient. z is up; units are metres. Needs
usd-core.
"""

import errno
import os
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, UsageError, refuse_faults, refuse_if
from splatctrl_cli.formats.splat.gaussian_ply import SplatFormat, check_gaussians, unit_quaternions
from splatctrl_cli.records import Array, Float32, GaussianSet, Label

PRIM_TYPE = "ParticleField3DGaussianSplat"
HARMONICS = "radiance:sphericalHarmonicsCoefficients"
DEGREE = "radiance:sphericalHarmonicsDegree"
NAME = "field"  # of a temporary file: the library goes by the suffix


def write_usd(path: Path, gaussians: GaussianSet, comments: Mapping[str, str], *, suffix: str) -> None:
    """Write `gaussians` as ``.usda`` (text) or ``.usdc`` (binary); `comments` become custom data.

    Primvar ``label`` is written if some Gaussian is not an object. Raises UsageError without the library.
    """
    check_gaussians("Gaussians to write", gaussians)
    usd, geometry, volume, arrays, kinds = _library()
    stage = usd.Stage.CreateInMemory(suffix)
    geometry.SetStageUpAxis(stage, geometry.Tokens.z)
    geometry.SetStageMetersPerUnit(stage, 1.0)
    field = volume.ParticleField3DGaussianSplat.Define(stage, "/Splats")
    stage.SetDefaultPrim(field.GetPrim())
    g, to_float3 = gaussians, arrays.Vec3fArray.FromNumpy
    field.CreatePositionsAttr(to_float3(g.centers))
    field.CreateOrientationsAttr(arrays.QuatfArray.FromNumpy(np.roll(g.quats_wxyz, -1, axis=1)))
    field.CreateScalesAttr(to_float3(g.scales))
    field.CreateOpacitiesAttr(arrays.FloatArray.FromNumpy(g.opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(int(np.sqrt(g.harmonics.shape[1])) - 1)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(to_float3(g.harmonics.reshape(-1, 3)))
    reach = 3.0 * g.scales.max(axis=1, keepdims=True)
    corners = np.stack([(g.centers - reach).min(axis=0), (g.centers + reach).max(axis=0)])  # at any rotation
    field.CreateExtentAttr(to_float3(corners.astype(np.float32)))
    if (g.labels != Label.OBJECT).any():
        geometry.PrimvarsAPI(field).CreatePrimvar("label", kinds.IntArray, geometry.Tokens.vertex).Set(
            arrays.IntArray.FromNumpy(g.labels.astype(np.int32))
        )
    layer = stage.GetRootLayer()
    layer.customLayerData = {"frame": "world", **comments}
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        named = Path(folder) / f"{NAME}{suffix}"
        try:
            layer.Export(str(named))
        except Exception as error:  # of the library's own type; it repeats itself for every block
            code = errno.ENOSPC if os.strerror(errno.ENOSPC) in str(error) else errno.EIO
            raise OSError(code, os.strerror(code), str(path)) from None
        named.replace(path)


def read_usd(path: Path, *, suffix: str) -> tuple[GaussianSet, dict[str, str]]:
    """Read a USD file's only particle field, and its custom data.

    Transforms are not applied. Raises InputError if unreadable or without exactly one field, UsageError without the
    library.
    """
    usd, geometry, *_ = _library()
    refuse_if(not path.is_file(), f"{path}: cannot be read: no such file")
    with tempfile.TemporaryDirectory() as folder:
        named = Path(folder) / f"{NAME}{suffix}"
        named.symlink_to(path.resolve())
        with refuse_faults(
            lambda _: f"{path}: no USD file that the library can open", Exception
        ):  # of the library's own type; it names lines of its source
            stage = usd.Stage.Open(str(named))
        prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == PRIM_TYPE]
        refuse_if(len(prims) != 1, f"{path}: expected one {PRIM_TYPE}, got {len(prims)}")
        gaussians = _gaussians(path, prims[0], geometry)
        comments = {key: str(value) for key, value in stage.GetRootLayer().customLayerData.items()}
    check_gaussians(str(path), gaussians)
    return gaussians, comments


def _library() -> tuple[Any, Any, Any, Any, Any]:
    with refuse_faults(
        lambda _: "USD: the library usd-core is not installed",
        ImportError,
        remedy="pip install 'splatctrl-cli[usd]'",
        error=UsageError,
    ):
        from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt
    refuse_if(
        getattr(UsdVol, PRIM_TYPE, None) is None,
        f"USD: expected usd-core 26.3 or later, which knows {PRIM_TYPE}, got {Usd.GetVersion()}",
        remedy="pip install 'splatctrl-cli[usd]'",
        error=UsageError,
    )
    return Usd, UsdGeom, UsdVol, Vt, Sdf.ValueTypeNames


def _gaussians(path: Path, prim: Any, geometry: Any) -> GaussianSet:
    centers = _array(path, prim, "positions", 3)
    num = len(centers)
    degree = int(prim.GetAttribute(DEGREE).Get())
    harmonics = _array(path, prim, HARMONICS, 3)
    refuse_if(
        len(harmonics) != num * (degree + 1) ** 2,
        f"{path}: {HARMONICS}: expected {(degree + 1) ** 2} for each of {num} Gaussians, got {len(harmonics)}",
    )
    primvars = geometry.PrimvarsAPI(prim)
    labels = np.asarray(primvars.GetPrimvar("label").Get() if primvars.HasPrimvar("label") else np.zeros(num))
    refuse_if(
        labels.shape != (num,) or labels.dtype.kind not in "iuf" or np.any((labels < 0) | (labels > 255)),
        f"{path}: label: expected a number from 0 to 255 for each of {num} Gaussians",
    )
    return GaussianSet(
        centers=centers,
        scales=_array(path, prim, "scales", 3),
        quats_wxyz=unit_quaternions(str(path), np.roll(_array(path, prim, "orientations", 4), 1, axis=1)),
        opacities=_array(path, prim, "opacities", 1)[:, 0],
        harmonics=harmonics.reshape(num, -1, 3),
        labels=labels.astype(np.uint8),
    )


def _array(path: Path, prim: Any, name: str, width: int) -> Float32:
    for candidate in (name, f"{name}h"):
        values = prim.GetAttribute(candidate).Get()
        if values is not None and len(values):
            table: Array = np.asarray(values).reshape(len(values), -1)
            if table.shape[1] == width:
                return table.astype(np.float32)
    raise InputError(f"{path}: its {PRIM_TYPE} has no {name}")


_DOCS = """
`.usda`, `.usdc` | OpenUSD, one `ParticleField3DGaussianSplat` | float32 | density
"""
ENTRIES = tuple(
    SplatFormat(
        name="OpenUSD particle field",
        order=order,
        suffix=suffix,
        write=partial(write_usd, suffix=suffix),
        read=partial(read_usd, suffix=suffix),
        check=_library,
        docs=docs,
    )
    for order, suffix, docs in ((4, ".usda", _DOCS), (5, ".usdc", ""))
)
