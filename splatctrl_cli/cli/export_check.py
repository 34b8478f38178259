"""Whether a written file of splats is its source: every value within the format's bound, and how both look."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.cli.common import table
from splatctrl_cli.errors import WriteError
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Float32, Float64, GaussianSet, Intrinsics, SplatSet
from splatctrl_cli.scene.gaussians import render_gaussians
from splatctrl_cli.scene.render import Rendering, render
from splatctrl_cli.splat_files.isotropic import as_gaussians
from splatctrl_cli.splat_files.splat_differences import Differences, differences
from splatctrl_cli.splat_files.splat_formats import SplatFormat
from splatctrl_cli.splat_files.splat_values import refuse

MIN_PSNR = 80.0  # [dB] of a format that rounds to float32 alone; measured: 107 and more, or the same
MAX_PIXEL_DIFFERENCE = 3 / 255  # there; the last bit can take a splat across the renderer's cut-off of 1/255
MAX_COLOR = 1e4  # of a sensor's 0 to 1, or of a harmonic; from 1e6 on an isotropic PLY looks otherwise
NUM_VIEWS = 4  # around the scene
IMAGE_SIZE = (320, 240)
SHOWN = {  # of Differences: what the table calls it, and the unit it is shown in
    "center": ("centre mm", 1e3),
    "sigma": ("sigma %", 1e2),
    "rotation": ("rotation deg", 1.0),
    "color": ("colour of 255", 255.0),
    "opacity": ("opacity of 255", 255.0),
    "harmonics": ("harmonics", 1.0),
}


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """How two sets look from `NUM_VIEWS` views around them.

    largest: difference of a colour, an opacity, or a depth over the scene's size; psnr [dB] of the colours of all
    pixels of all views, None where they are the same; covered: share of pixels where anything shows.
    """

    largest: float
    psnr: float | None
    covered: float


def check(
    out: "Path", kind: "SplatFormat", source: "SplatSet | GaussianSet", back: "SplatSet | GaussianSet"
) -> dict[str, Any]:
    """What of `source` the file keeps: differences, renders, what has no place in it.

    Raises WriteError where a value is farther off than the format's rounding, or an exact format looks different.
    """
    one, two = _gaussians(source), _gaussians(back)
    held, bound = kind.held(one), kind.bound(one)
    found = _differences(out, held, two, bound)
    comparison = compare(source, back)
    looks_the_same = comparison.psnr is None or comparison.psnr >= MIN_PSNR
    if not kind.is_rounded and not (looks_the_same and comparison.largest <= MAX_PIXEL_DIFFERENCE):
        raise WriteError(
            f"{out}: does not render as its source: PSNR {comparison.psnr} dB, largest pixel difference "
            f"{comparison.largest:.3g}, expected at least {MIN_PSNR:g} dB and at most {MAX_PIXEL_DIFFERENCE:.3g}"
        )
    return {
        "not_kept": _not_kept(source, back, held),
        "num_outside": _num_outside(one, held),
        "differences": asdict(found),
        "allowed": asdict(bound),
        "num_views_compared": NUM_VIEWS,
        "largest_pixel_difference": comparison.largest,
        "psnr": comparison.psnr,
        "covered_share": comparison.covered,
    }


def check_colors(source: "Path", splats: "SplatSet | GaussianSet") -> None:
    """Raise InputError naming the first splat whose colour no picture has: beside it float32 loses the others."""
    colors = splats.colors if isinstance(splats, SplatSet) else splats.harmonics.reshape(len(splats), -1)
    largest = np.abs(colors).max(axis=1, initial=0.0)
    refuse(str(source), "colour", largest, largest > MAX_COLOR, f"at most {MAX_COLOR:g}")


def _gaussians(splats: "SplatSet | GaussianSet") -> "GaussianSet":
    return as_gaussians(splats) if isinstance(splats, SplatSet) else splats


def _differences(out: "Path", held: "GaussianSet", back: "GaussianSet", bound: "Differences") -> "Differences":
    if len(held) != len(back) or not np.array_equal(held.labels, back.labels):
        raise WriteError(f"{out}: is not its source: {len(back)} of {len(held)} splats, or other labels")
    found = differences(held, back)
    beyond = found.beyond(bound)
    if beyond:
        raise WriteError(f"{out}: is not its source: {'; '.join(beyond)}")
    return found


def _not_kept(source: "SplatSet | GaussianSet", back: "SplatSet | GaussianSet", held: "GaussianSet") -> list[str]:
    """What the source has and the format has no place for."""
    lost = []
    if (source.labels != back.labels).any():
        lost.append("labels")
    if isinstance(source, SplatSet) and isinstance(back, SplatSet) and (source.density != back.density).any():
        lost.append("density")
    if isinstance(source, GaussianSet) and held.harmonics.shape[1] < source.harmonics.shape[1]:
        lost.append("colour by side")
    return lost


def _num_outside(source: "GaussianSet", held: "GaussianSet") -> int:
    """How many Gaussians have a sigma or colour beyond what the format can hold, and were put at its edge."""
    harmonics = source.harmonics[:, : held.harmonics.shape[1]]
    is_outside = (held.harmonics != harmonics).any(axis=(1, 2)) | (held.scales != source.scales).any(axis=1)
    return int(np.count_nonzero(is_outside))


def difference_table(found: Mapping[str, float], allowed: Mapping[str, float]) -> list[str]:
    """Lines of a table: the largest difference of each kind of value, and what the format may cause."""
    rows = [(name, f"{found[key] * unit:.3g}", f"{allowed[key] * unit:.3g}") for key, (name, unit) in SHOWN.items()]
    return table(["largest difference", "found", "allowed"], rows)


def compare(a: "SplatSet | GaussianSet", b: "SplatSet | GaussianSet") -> Comparison:
    """Renders of both sets, seen from around `a`."""
    intrinsics, poses, size = _views(a.centers)
    largest, covered, squared = 0.0, 0.0, 0.0
    for T_world_camera in poses:
        one, two = (_render(splats, intrinsics, T_world_camera) for splats in (a, b))
        pairs = ((one.color, two.color), (one.opacity, two.opacity), (one.depth / size, two.depth / size))
        largest = max(largest, *(float(np.abs(x.astype(np.float64) - y).max()) for x, y in pairs))
        covered += float(np.mean(one.opacity > 0)) / len(poses)
        squared += float(np.mean(np.square(one.color.astype(np.float64) - two.color))) / len(poses)
    return Comparison(largest=largest, psnr=-10.0 * math.log10(squared) if squared else None, covered=covered)


def _render(splats: "SplatSet | GaussianSet", intrinsics: "Intrinsics", T_world_camera: "Float64") -> "Rendering":
    if isinstance(splats, SplatSet):
        return render(splats, intrinsics, T_world_camera)
    return render_gaussians(splats, intrinsics, T_world_camera)


def _views(centers: "Float32") -> tuple["Intrinsics", "Sequence[Float64]", float]:
    """Cameras evenly around the box that holds most of the splats, from above, and that box's diagonal [m]."""
    lower, upper = np.percentile(centers.astype(np.float64), [2, 98], axis=0)
    middle, size = (lower + upper) / 2, max(float(np.linalg.norm(upper - lower)), 0.1)
    width, height = IMAGE_SIZE
    intrinsics = Intrinsics(fx=width, fy=width, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height)
    angles = 2 * np.pi * (np.arange(NUM_VIEWS) + 0.5) / NUM_VIEWS
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.full(NUM_VIEWS, 0.7)])
    return intrinsics, [look_at(middle + size * direction, middle) for direction in directions], size
