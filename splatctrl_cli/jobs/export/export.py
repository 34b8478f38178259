"""An export from its request to its result: splats in a viewer's format, read back and rendered before they count."""

import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import EXPORT_DIFFERENCE, EXPORT_MAX_COLOR, EXPORT_MIN_PSNR, EXPORT_VIEWS
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError, WriteError
from splatctrl_cli.files.output import output_path, sha256
from splatctrl_cli.formats.splat.gaussian_ply import REFERENCE_PLY
from splatctrl_cli.formats.splat.splat_format import Comments, Differences, SplatFormat, differences, refuse
from splatctrl_cli.formats.splat.splats import (
    FORMATS,
    ORIGIN,
    as_gaussians,
    as_splats,
    check_no_shell,
    format_of,
    nearest_splats,
    read_ply,
    read_source,
    write_ply,
)
from splatctrl_cli.geometry import look_at
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.records import Float32, Float64, GaussianSet, Intrinsics, Label, SplatSet
from splatctrl_cli.scene.gaussians import render_gaussians
from splatctrl_cli.scene.render import Rendering, render

LAYOUT_COMMENTS = frozenset({"splat", "label"})  # say how a PLY holds its values: not true of the next file
IMAGE_SIZE = (320, 240)

Splats = SplatSet | GaussianSet


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """One export of `scene`, a scene folder or a file of splats, into the file `out`, whose suffix is the format.

    out: None for a PLY beside the scene. labels: of the splats to write, None for all. layout: of a PLY, "short" or
    "full", None for the one that loses nothing. isotropic: make anisotropic Gaussians round.
    """

    scene: Path
    out: Path | None = None
    labels: Collection[Label] | None = None
    layout: str | None = None
    isotropic: bool = False
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """The file, and what it keeps of its source.

    num_left_out: splats of other labels. origin: what was taken off every centre [m], in words, None for nothing.
    not_kept: what the format has no place for; num_outside: Gaussians with a
    sigma or colour beyond its range, which are put at its edge. differences, and what the format allows of them. Over
    the pixels of all views around the scene: largest_pixel_difference of a colour, an opacity, or a depth over the
    scene's size; psnr [dB], None where the colours are the same; covered_share, where anything shows. isotropic_psnr:
    likewise of what `was_rounded` beside the source.
    """

    file: Path
    format: str
    bytes: int
    sha256: str
    num_splats: int
    num_left_out: int
    origin: str | None = None
    not_kept: tuple[str, ...]
    num_outside: int
    differences: Differences
    allowed: Differences
    num_views_compared: int = EXPORT_VIEWS
    largest_pixel_difference: float
    psnr: float | None
    covered_share: float
    isotropic_psnr: float | None
    was_rounded: bool

    def as_dict(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self).items() if name != "was_rounded"}


def export(request: ExportRequest, progress: Progress = SILENT) -> ExportResult:
    """Write the splats, read them back and compare.

    Raises UsageError, InputError or NotEvaluableError for what cannot be written so, and WriteError, leaving no file,
    where a value is farther off than the format's rounding, or an exact format looks different.
    """
    source = _splat_file(request.scene)
    out = request.out or _beside(request.scene)
    kind = _format(out, request.layout)
    if os.path.realpath(out) == os.path.realpath(source):
        raise UsageError(f"{out}: is the input itself", remedy="give another --out")
    splats, comments, exact = read_source(source)
    check_no_shell(source, comments)  # most formats would lose what tells it from surfaces
    _check_colors(source, splats)
    is_chosen = np.isin(splats.labels, [*Label] if request.labels is None else list(request.labels))
    selected, exact = (splats, exact) if request.labels is None else (splats.select(is_chosen), exact[is_chosen])
    if not len(selected):
        raise NotEvaluableError(f"{source}: no splat to write among {len(splats)}", remedy="give other --labels")
    chosen = nearest_splats(selected) if request.isotropic and isinstance(selected, GaussianSet) else selected
    if request.layout == "short" and isinstance(chosen, GaussianSet):
        raise UsageError(
            f"--layout short: expected isotropic splats, {source} has {len(chosen)} Gaussians that are not all so",
            remedy="give --isotropic, or --layout full",
        )
    kept = {key: value for key, value in comments.items() if key not in LAYOUT_COMMENTS}
    name = source.name if source.name.isprintable() else ascii(source.name)
    with output_path(out, force=request.force, is_folder=False) as partial:
        kept |= {"exported_from": f"{name} sha256 {sha256(source)}"}
        back, said = _written(partial, kind, chosen, kept)
        before, after = _gaussians(chosen), _gaussians(back)
        held, bound = kind.held(before), kind.bound(before)
        bound = replace(bound, center=bound.center + float(np.abs(exact - before.centers).max()))
        found = _checked_differences(out, held, after, bound, exact)
        largest, psnr, covered = _checked_look(out, kind, chosen, back)
        return ExportResult(
            file=out,
            format=kind.name,
            bytes=partial.stat().st_size,
            sha256=sha256(partial),
            num_splats=len(chosen),
            num_left_out=len(splats) - len(chosen),
            origin=comments.get(ORIGIN),
            not_kept=(*_not_kept(chosen, back, held), *({ORIGIN} & comments.keys() - said.keys())),
            num_outside=_num_outside(before, held),
            differences=found,
            allowed=bound,
            largest_pixel_difference=largest,
            psnr=psnr,
            covered_share=covered,
            isotropic_psnr=None if chosen is selected else _look(selected, chosen)[1],
            was_rounded=chosen is not selected,
        )


def _beside(scene: Path) -> Path:
    place = scene if scene.name.strip(".") else Path(os.path.realpath(scene))  # . and .. have no name of their own
    suffix = "" if scene.is_dir() else scene.suffix
    return place.with_name(f"{place.name.removesuffix(suffix)}.ply")


def _splat_file(scene: Path) -> Path:
    file = scene / "splats.ply" if scene.is_dir() else scene
    if not file.is_file():
        said = "has no splats.ply" if scene.exists() else "no such scene"
        raise InputError(f"{scene}: {said}", remedy="give a folder that reconstruct wrote, or a splat file")
    return file


def _format(out: Path, layout: str | None) -> SplatFormat:
    kind = format_of(out)
    if layout is not None and kind is not FORMATS[".ply"]:
        raise UsageError(f"--layout {layout}: {out} is not a PLY", remedy="leave it out")
    return REFERENCE_PLY if layout == "full" else kind


def _check_colors(source: Path, splats: Splats) -> None:
    """Raise InputError naming the first splat whose colour no picture has: beside it float32 loses the others."""
    colors = splats.colors if isinstance(splats, SplatSet) else splats.harmonics.reshape(len(splats), -1)
    largest = np.abs(colors).max(axis=1, initial=0.0)
    refuse(str(source), "colour", largest, largest > EXPORT_MAX_COLOR, f"at most {EXPORT_MAX_COLOR:g}")


def _written(
    partial: Path, kind: SplatFormat, splats: Splats, comments: Mapping[str, str]
) -> tuple[Splats, Comments]:
    """Write the splats and return what reads back; isotropic ones in a PLY keep their density."""
    if isinstance(splats, SplatSet) and kind is FORMATS[".ply"]:
        write_ply(partial, splats, comments)
        return read_ply(partial)
    kind.write(partial, _gaussians(splats), comments)
    back, said = kind.read(partial)
    return back if isinstance(splats, GaussianSet) else as_splats(back, str(partial)), said


def _gaussians(splats: Splats) -> GaussianSet:
    return as_gaussians(splats) if isinstance(splats, SplatSet) else splats


def _checked_differences(
    out: Path, held: GaussianSet, back: GaussianSet, bound: Differences, exact: Float64
) -> Differences:
    if len(held) != len(back) or not np.array_equal(held.labels, back.labels):
        raise WriteError(f"{out}: differs from its source: {len(back)} of {len(held)} splats, or other labels")
    found = differences(held, back, exact)
    beyond = found.beyond(bound)
    if beyond:
        raise WriteError(f"{out}: differs from its source: {'; '.join(beyond)}")
    return found


def _checked_look(out: Path, kind: SplatFormat, source: Splats, back: Splats) -> tuple[float, float | None, float]:
    largest, psnr, covered = _look(source, back)
    looks_the_same = psnr is None or psnr >= EXPORT_MIN_PSNR
    if not kind.is_rounded and not (looks_the_same and largest <= EXPORT_DIFFERENCE):
        raise WriteError(
            f"{out}: does not render as its source: PSNR {psnr} dB, largest pixel difference "
            f"{largest:.3g}, expected at least {EXPORT_MIN_PSNR:g} dB and at most {EXPORT_DIFFERENCE:.3g}"
        )
    return largest, psnr, covered


def _not_kept(source: Splats, back: Splats, held: GaussianSet) -> list[str]:
    """What the source has and the format has no place for."""
    lost = []
    if (source.labels != back.labels).any():
        lost.append("labels")
    if isinstance(source, SplatSet) and isinstance(back, SplatSet) and (source.density != back.density).any():
        lost.append("density")
    if isinstance(source, GaussianSet) and held.harmonics.shape[1] < source.harmonics.shape[1]:
        lost.append("view-dependent colour")
    return lost


def _num_outside(source: GaussianSet, held: GaussianSet) -> int:
    harmonics = source.harmonics[:, : held.harmonics.shape[1]]
    is_outside = (held.harmonics != harmonics).any(axis=(1, 2)) | (held.scales != source.scales).any(axis=1)
    return int(np.count_nonzero(is_outside))


def _look(a: Splats, b: Splats) -> tuple[float, float | None, float]:
    """Render both sets from around `a`: their largest difference, PSNR and covered share, as in `ExportResult`."""
    intrinsics, poses, size = _views(a.centers)
    largest, covered, squared = 0.0, 0.0, 0.0
    for T_world_camera in poses:
        one, two = (_render(splats, intrinsics, T_world_camera) for splats in (a, b))
        pairs = ((one.color, two.color), (one.opacity, two.opacity), (one.depth / size, two.depth / size))
        largest = max(largest, *(float(np.abs(x.astype(np.float64) - y).max()) for x, y in pairs))
        covered += float(np.mean(one.opacity > 0)) / len(poses)
        squared += float(np.mean(np.square(one.color.astype(np.float64) - two.color))) / len(poses)
    return largest, -10.0 * math.log10(squared) if squared else None, covered


def _render(splats: Splats, intrinsics: Intrinsics, T_world_camera: Float64) -> Rendering:
    if isinstance(splats, SplatSet):
        return render(splats, intrinsics, T_world_camera)
    return render_gaussians(splats, intrinsics, T_world_camera)


def _views(centers: Float32) -> tuple[Intrinsics, Sequence[Float64], float]:
    """Cameras evenly around the box that holds most of the splats, from above, and that box's diagonal [m]."""
    lower, upper = np.percentile(centers.astype(np.float64), [2, 98], axis=0)
    middle, size = (lower + upper) / 2, max(float(np.linalg.norm(upper - lower)), 0.1)
    width, height = IMAGE_SIZE
    intrinsics = Intrinsics(fx=width, fy=width, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height)
    angles = 2 * np.pi * (np.arange(EXPORT_VIEWS) + 0.5) / EXPORT_VIEWS
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.full(EXPORT_VIEWS, 0.7)])
    return intrinsics, [look_at(middle + size * direction, middle) for direction in directions], size
