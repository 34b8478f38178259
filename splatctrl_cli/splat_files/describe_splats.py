"""What a file of splats of a binary format holds: it is read whole, because its header says little."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.files.summary import Summary
from splatctrl_cli.records import Label, SplatSet
from splatctrl_cli.splat_files.isotropic import as_gaussians
from splatctrl_cli.splat_files.splat_formats import format_of, read_splats


def describe_splats(path: Path, _head: bytes) -> Summary:
    """Number, shape, box and ranges of the splats of a file. Raises InputError for one that is none."""
    splats, comments = read_splats(path)
    is_isotropic = isinstance(splats, SplatSet)
    gaussians = as_gaussians(splats) if isinstance(splats, SplatSet) else splats
    facts: dict[str, object] = {
        "format": format_of(path).name,
        "splats": len(gaussians),
        "shape": "isotropic" if is_isotropic else "anisotropic",
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
