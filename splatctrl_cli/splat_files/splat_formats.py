"""The files that hold splats, by suffix: what any of them holds, read or described."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.files.ply import read_table
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.libraries import entries_of
from splatctrl_cli.records import GaussianSet, Label, SplatSet
from splatctrl_cli.splat_files import splats
from splatctrl_cli.splat_files.gaussian_ply import REFERENCE_PLY, gaussians_of
from splatctrl_cli.splat_files.splat_format import Comments, SplatFormat
from splatctrl_cli.splat_files.splats import as_gaussians, as_splats, check_world, is_isotropic, read_world_splats

__all__ = ["FORMATS", "REFERENCE_PLY", "SplatFormat", "describe_splats", "format_of", "read_spheres", "read_splats"]

FORMATS: Mapping[str, SplatFormat] = {kind.suffix: kind for kind in entries_of(__package__, SplatFormat)}


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
    return gaussians_of(ply), ply.pairs()


def read_spheres(path: Path) -> SplatSet:
    """The splats of a file of any format as spheres in the world, which have distances; harmonics above the constant
    one are only colour and are left out. Raises InputError as `read_splats`, and for splats that are not
    round, in another unit or another frame.
    """
    if (path.suffix.lower() or ".ply") == ".ply":
        return read_world_splats(path)
    found, comments = read_splats(path)
    check_world(path, comments)
    if isinstance(found, SplatSet):
        return found
    return as_splats(replace(found, harmonics=found.harmonics[:, :1]), str(path))


def describe_splats(path: Path, _head: bytes) -> Summary:
    """Number, shape, box and ranges of the splats of a file. Raises InputError for a file of another kind."""
    found, comments = read_splats(path)
    gaussians = as_gaussians(found) if isinstance(found, SplatSet) else found
    facts: dict[str, object] = {
        "format": format_of(path).name,
        "splats": len(gaussians),
        "shape": "isotropic" if isinstance(found, SplatSet) else "anisotropic",
        "degree_of_harmonics": int(np.sqrt(gaussians.harmonics.shape[1])) - 1,
    }
    if (gaussians.labels != Label.OBJECT).any():
        facts["labels"] = {label.name.lower(): int(np.count_nonzero(gaussians.labels == label)) for label in Label}
    if len(gaussians):
        facts["lower_m"] = _rounded(gaussians.centers.min(axis=0))
        facts["upper_m"] = _rounded(gaussians.centers.max(axis=0))
        facts["sigma_m"] = _rounded(np.percentile(gaussians.scales, [0, 50, 100]))
        facts["opacity"] = _rounded(np.percentile(gaussians.opacities, [0, 50, 100]))
    facts["comments"] = comments
    return Summary(path=str(path), kind="splats", facts=facts)


def _rounded(values: NDArray[np.floating]) -> list[float]:
    return [float(f"{value:.4g}") for value in values]
