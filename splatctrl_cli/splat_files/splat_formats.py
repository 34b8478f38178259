"""The files that hold splats: how each suffix is written and read, and how exact it is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.files.ply import read_table
from splatctrl_cli.records import GaussianSet, SplatSet
from splatctrl_cli.splat_files import gaussian_ply, gltf, splat_file, splats, spz, usd
from splatctrl_cli.splat_files.isotropic import as_splats, is_isotropic
from splatctrl_cli.splat_files.splat_differences import Differences, float32_bound

Comments = dict[str, str]


@dataclass(frozen=True, kw_only=True)
class SplatFormat:
    """One kind of file. `held` is what of a set it can hold, before rounding; `bound` is how far it may round."""

    name: str
    write: Callable[[Path, GaussianSet, Mapping[str, str]], None]
    read: Callable[[Path], tuple[GaussianSet, Comments]]
    held: Callable[[GaussianSet], GaussianSet]
    bound: Callable[[GaussianSet], Differences]
    is_rounded: bool


def _all(gaussians: GaussianSet) -> GaussianSet:
    return gaussians


def _without_labels(gaussians: GaussianSet) -> GaussianSet:
    return replace(gaussians, labels=np.zeros_like(gaussians.labels))


def _usd(suffix: str) -> SplatFormat:
    return SplatFormat(
        name="OpenUSD particle field",
        write=partial(usd.write_usd, suffix=suffix),
        read=partial(usd.read_usd, suffix=suffix),
        held=_all,
        bound=float32_bound,
        is_rounded=False,
    )


def _write_reference_ply(path: Path, gaussians: GaussianSet, comments: Mapping[str, str]) -> None:
    gaussian_ply.write_gaussian_ply(path, _without_labels(gaussians), comments)


REFERENCE_PLY = SplatFormat(
    name="3D-GS PLY, 62 properties",
    write=_write_reference_ply,
    read=gaussian_ply.read_gaussian_ply,
    held=_without_labels,
    bound=float32_bound,
    is_rounded=False,
)
FORMATS = {
    ".ply": replace(REFERENCE_PLY, name="3D-GS PLY", write=gaussian_ply.write_gaussian_ply, held=_all),
    ".splat": SplatFormat(
        name=".splat, 32 bytes each",
        write=splat_file.write_splat,
        read=splat_file.read_splat,
        held=splat_file.held_by_splat,
        bound=splat_file.splat_bound,
        is_rounded=True,
    ),
    ".spz": SplatFormat(
        name=".spz version 3",
        write=spz.write_spz,
        read=spz.read_spz,
        held=spz.held_by_spz,
        bound=spz.spz_bound,
        is_rounded=True,
    ),
    ".glb": SplatFormat(
        name="glTF with KHR_gaussian_splatting",
        write=gltf.write_glb,
        read=gltf.read_gltf,
        held=_all,
        bound=float32_bound,
        is_rounded=False,
    ),
    ".usda": _usd(".usda"),
    ".usdc": _usd(".usdc"),
}


def format_of(path: Path) -> SplatFormat:
    """The format that the suffix of `path` names, PLY without one. Raises UsageError for an unknown one."""
    found = FORMATS.get(path.suffix.lower() or ".ply")
    if found is None:
        raise UsageError(f"{path}: expected a suffix of {', '.join(FORMATS)}, got {path.suffix}")
    return found


def read_splats(path: Path) -> tuple[SplatSet | GaussianSet, Comments]:
    """What a file of splats holds, and its comments: a SplatSet where all are round and of one colour by side.

    Raises InputError for a file that is missing, not whole, of an unknown kind, or holds what is no splat.
    """
    try:
        kind = format_of(path)
    except UsageError as error:
        raise InputError(error.message) from None
    if kind is not FORMATS[".ply"]:
        gaussians, comments = kind.read(path)
        return (as_splats(gaussians, str(path)) if is_isotropic(gaussians) else gaussians), comments
    ply = read_table(path, "vertex", splats.REQUIRED)
    has_rest = any(name.startswith("f_rest_") and ply.column(name).any() for name in ply.names)
    if splats.num_stretched(ply) == 0 and not has_rest:
        return splats.splats_of(ply), ply.pairs()
    return gaussian_ply.gaussians_of(ply), ply.pairs()
