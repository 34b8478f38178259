"""An export: splats in a viewer's format, or a run as Foxglove MCAP.

Written splats are read back and rendered before the file is kept.
"""

import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import methodcaller
from pathlib import Path

import numpy as np

from splatctrl_cli.config.fixed import EXPORT_DIFFERENCE, EXPORT_MAX_COLOR, EXPORT_MIN_PSNR, EXPORT_VIEWS
from splatctrl_cli.control.columns import INTERVENTIONS, SHOWN
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError, WriteError, refuse_if, require
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.files.output import finite, output_path, sha256
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import Snapshot, open_scene
from splatctrl_cli.formats.splat.gaussian_ply import (
    REFERENCE_PLY,
    Comments,
    Differences,
    SplatFormat,
    differences,
    refuse,
)
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
from splatctrl_cli.jobs.report.spaces import position_of, robot_bodies, robot_of, scene_of, sets_known, spread
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.runs.run_folder import (
    REPLAY,
    FolderRequest,
    RunFolder,
    States,
    open_run,
    sibling_path,
)
from splatctrl_cli.jobs.score.views import render_splats
from splatctrl_cli.recording.container.mcap_writer import FoxgloveLog, foxglove_log
from splatctrl_cli.records import Float32, Float64, GaussianSet, Intrinsics, Label, SplatSet

Splats = SplatSet | GaussianSet


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """Export of a scene or splat file; the suffix of `out` is the format.

    out: None for a PLY next to the scene. labels: None for all. layout: of a PLY, "short" or "full", None for the
    lossless layout. isotropic: make anisotropic Gaussians round.
    """

    scene: Path
    out: Path | None = None
    labels: Collection[Label] | None = None
    layout: str | None = None
    isotropic: bool = False
    force: bool = False


def export(request: ExportRequest, progress: Progress = SILENT) -> Result:
    """Write the splats, read them back and compare.

    Metrics: origin [m]: subtracted from every centre, in words. not_kept: attributes that the format lacks.
    num_outside: splats clamped to the format's range. differences: largest found; allowed: largest by the format's
    rounding. Over all views: largest_pixel_difference in colour, opacity, or depth per scene size; psnr [dB], None if
    equal; covered_share of the pixels. isotropic_psnr [dB]: of round splats against the source.

    Raises UsageError, InputError or NotEvaluableError for unsuitable splats. Raises WriteError, leaving no file, for
    errors above the format's rounding.
    """
    source = _splat_file(request.scene)
    out = request.out or sibling_path(request.scene, ".ply")
    kind = _format(out, request.layout)
    refuse_if(
        os.path.realpath(out) == os.path.realpath(source),
        f"{out}: is the input itself",
        remedy="give another --out",
        error=UsageError,
    )
    splats, comments, exact = read_source(source)
    check_no_shell(source, comments)  # most formats would lose the mark that separates it from surfaces
    _check_colors(source, splats)
    is_chosen = np.isin(splats.labels, [*Label] if request.labels is None else list(request.labels))
    selected, exact = (splats, exact) if request.labels is None else (splats.select(is_chosen), exact[is_chosen])
    refuse_if(
        not len(selected),
        f"{source}: no splat to write among {len(splats)}",
        remedy="give other --labels",
        error=NotEvaluableError,
    )
    chosen = nearest_splats(selected) if request.isotropic and isinstance(selected, GaussianSet) else selected
    refuse_if(
        request.layout == "short" and isinstance(chosen, GaussianSet),
        f"--layout short: expected isotropic splats, {source} has {len(chosen)} Gaussians that are not all so",
        remedy="give --isotropic, or --layout full",
        error=UsageError,
    )
    # these describe a PLY's layout: wrong for the next file
    own_comments = {key: value for key, value in comments.items() if key not in {"splat", "label"}}
    name = source.name if source.name.isprintable() else ascii(source.name)
    with output_path(out, force=request.force, is_folder=False) as partial:
        own_comments |= {"exported_from": f"{name} sha256 {sha256(source)}"}
        back, written = _write_scene(partial, kind, chosen, own_comments)
        before, after = _gaussians(chosen), _gaussians(back)
        reduced, bound = kind.reduce(before), kind.bound(before)
        bound = replace(bound, center=bound.center + float(np.abs(exact - before.centers).max()))
        changes = _check_differences(out, reduced, after, bound, exact)
        largest, psnr, covered = _check_look(out, kind, chosen, back)
        rounded = None if chosen is selected else _look(selected, chosen)[1]
        origin, num_outside = comments.get(ORIGIN), _num_outside(before, reduced)
        not_kept = (*_not_kept(chosen, back, reduced), *({ORIGIN} & comments.keys() - written.keys()))
        metrics = {
            "format": kind.name,
            "bytes": partial.stat().st_size,
            "sha256": sha256(partial),
            "num_splats": len(chosen),
            "num_left_out": len(splats) - len(chosen),
            "origin": origin,
            "not_kept": not_kept,
            "num_outside": num_outside,
            "differences": asdict(changes),
            "allowed": asdict(bound),
            "num_views_compared": EXPORT_VIEWS,
            "largest_pixel_difference": largest,
            "psnr": psnr,
            "covered_share": covered,
            "isotropic_psnr": rounded,
        }
    texts = {
        f"made isotropic: {decibels(rounded)} against the source": chosen is not selected,
        f"centres are less the origin {origin} m: float32 would move them without": origin,
        f"not kept: {', '.join(not_kept)}": not_kept,
        f"{num_outside} splats have a size or colour beyond the format's range: put at its edge": num_outside,
    }
    notes = tuple(text for text, holds in texts.items() if holds)
    return Result(out=out, metrics=metrics, notes=notes, document={"file": out, **metrics})


def decibels(psnr: float | None) -> str:
    return "the same" if psnr is None else f"PSNR {psnr:.1f} dB"


def _splat_file(scene: Path) -> Path:
    file = scene / "splats.ply" if scene.is_dir() else scene
    refuse_if(
        not file.is_file(),
        f"{scene}: {'has no splats.ply' if scene.exists() else 'no such scene'}",
        remedy="give a folder that reconstruct wrote, or a splat file",
    )
    return file


def _format(out: Path, layout: str | None) -> SplatFormat:
    kind = format_of(out)
    refuse_if(
        layout is not None and kind is not FORMATS[".ply"],
        f"--layout {layout}: {out} is not a PLY",
        remedy="leave it out",
        error=UsageError,
    )
    return REFERENCE_PLY if layout == "full" else kind


def _check_colors(source: Path, splats: Splats) -> None:
    """Raise InputError for a colour so large that float32 loses other colours."""
    colors = splats.colors if isinstance(splats, SplatSet) else splats.harmonics.reshape(len(splats), -1)
    largest = np.abs(colors).max(axis=1, initial=0.0)
    refuse(str(source), "colour", largest, largest > EXPORT_MAX_COLOR, f"at most {EXPORT_MAX_COLOR:g}")


def _write_scene(
    partial: Path, kind: SplatFormat, splats: Splats, comments: Mapping[str, str]
) -> tuple[Splats, Comments]:
    if isinstance(splats, SplatSet) and kind is FORMATS[".ply"]:
        write_ply(partial, splats, comments)
        return read_ply(partial)
    kind.write(partial, _gaussians(splats), comments)
    back, written = kind.read(partial)
    return back if isinstance(splats, GaussianSet) else as_splats(back, str(partial)), written


def _gaussians(splats: Splats) -> GaussianSet:
    return as_gaussians(splats) if isinstance(splats, SplatSet) else splats


def _check_differences(
    out: Path, reduced: GaussianSet, back: GaussianSet, bound: Differences, exact: Float64
) -> Differences:
    refuse_if(
        len(reduced) != len(back) or not np.array_equal(reduced.labels, back.labels),
        f"{out}: differs from its source: {len(back)} of {len(reduced)} splats, or other labels",
        error=WriteError,
    )
    changes = differences(reduced, back, exact)
    refuse_if(
        beyond := changes.beyond(bound), f"{out}: differs from its source: {'; '.join(beyond)}", error=WriteError
    )
    return changes


def _check_look(out: Path, kind: SplatFormat, source: Splats, back: Splats) -> tuple[float, float | None, float]:
    largest, psnr, covered = _look(source, back)
    looks_the_same = psnr is None or psnr >= EXPORT_MIN_PSNR
    refuse_if(
        not kind.is_rounded and not (looks_the_same and largest <= EXPORT_DIFFERENCE),
        f"{out}: does not render as its source: PSNR {psnr} dB, largest pixel difference "
        f"{largest:.3g}, expected at least {EXPORT_MIN_PSNR:g} dB and at most {EXPORT_DIFFERENCE:.3g}",
        error=WriteError,
    )
    return largest, psnr, covered


def _not_kept(source: Splats, back: Splats, reduced: GaussianSet) -> list[str]:
    lost = {
        "labels": (source.labels != back.labels).any(),
        "density": isinstance(source, SplatSet)
        and isinstance(back, SplatSet)
        and (source.density != back.density).any(),
        "view-dependent colour": isinstance(source, GaussianSet)
        and reduced.harmonics.shape[1] < source.harmonics.shape[1],
    }
    return [name for name, is_lost in lost.items() if is_lost]


def _num_outside(source: GaussianSet, reduced: GaussianSet) -> int:
    harmonics = source.harmonics[:, : reduced.harmonics.shape[1]]
    is_outside = (reduced.harmonics != harmonics).any(axis=(1, 2)) | (reduced.scales != source.scales).any(axis=1)
    return int(np.count_nonzero(is_outside))


def _look(a: Splats, b: Splats) -> tuple[float, float | None, float]:
    """Largest difference, PSNR and covered share of renders around `a`."""
    intrinsics, poses, size = _views(a.centers)
    largest, covered, squared = 0.0, 0.0, 0.0
    for T_world_camera in poses:
        one, two = (render_splats(splats, intrinsics, T_world_camera) for splats in (a, b))
        pairs = ((one.color, two.color), (one.opacity, two.opacity), (one.depth / size, two.depth / size))
        largest = max(largest, *(float(np.abs(x.astype(np.float64) - y).max()) for x, y in pairs))
        covered += float(np.mean(one.opacity > 0)) / len(poses)
        squared += float(np.mean(np.square(one.color.astype(np.float64) - two.color))) / len(poses)
    return largest, -10.0 * math.log10(squared) if squared else None, covered


def _views(centers: Float32) -> tuple[Intrinsics, Sequence[Float64], float]:
    """Cameras around most splats, and the diagonal [m] of these splats."""
    lower, upper = np.percentile(centers.astype(np.float64), [2, 98], axis=0)
    middle, size = (lower + upper) / 2, max(float(np.linalg.norm(upper - lower)), 0.1)
    width, height = 320, 240
    intrinsics = Intrinsics(fx=width, fy=width, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height)
    angles = 2 * np.pi * (np.arange(EXPORT_VIEWS) + 0.5) / EXPORT_VIEWS
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.full(EXPORT_VIEWS, 0.7)])
    return intrinsics, [look_at(middle + size * direction, middle) for direction in directions], size


FREE_BELOW, OCCUPIED_ABOVE = 0.3, 0.7  # for snapshots, whose log-odds are coarse
CLOUD, SPACE, DISTANCE, TRANSFORMS = "/splats", "/known_space", "/distance", "/tf"
MESHES, EVENTS, CLEARANCE = "/arm", "/events", "/clearance"
Later = tuple[int, int, Callable[[FoxgloveLog], None]]  # stamp [ns], order within a stamp, writer


@dataclass(frozen=True, kw_only=True)
class ExportRunRequest(FolderRequest):
    """Export of a replay, scene or field folder to MCAP; out: None for PATH.mcap."""


def export_run(request: ExportRunRequest) -> Result:
    """Write the MCAP; metrics: bytes, messages by topic.

    Raises InputError for another kind of folder, UsageError for a missing library.
    """
    parts = sorted(_parts(open_run(request.path), request.roots), key=lambda part: part[:2])
    out = request.out or sibling_path(request.path.absolute(), ".mcap")
    with output_path(out, force=request.force, is_folder=False) as written:
        with foxglove_log(written) as log:
            for _, _, write in parts:
                write(log)
        metrics = {"bytes": written.stat().st_size, "messages": dict(log.counts)}
    return Result(out=out, metrics=metrics, document={"file": out, **metrics})


def _parts(run: RunFolder, roots: tuple[Path, ...]) -> Iterator[Later]:
    if run.command == REPLAY:
        states = require(run.states, f"{run.path}: no steps.csv", remedy="replay again")
        yield from _replay_parts(run, states, roots)
    elif (run.path / "field.npz").is_file():
        yield 0, 0, partial(_field, 0, run.parts.checked(run.path / "field.npz"))
    elif (run.path / "splats.ply").is_file():
        yield from _space_parts([(snapshot.stamp_ns, snapshot) for snapshot in open_scene(run.path).snapshots])
    else:
        raise InputError(f"{run.path}: {run.command} leaves nothing to log", remedy="give a replay, scene or field")


def _replay_parts(run: RunFolder, states: States, roots: tuple[Path, ...]) -> Iterator[Later]:
    start = int(states.stamps_ns[0])
    if (grid := run.option("--field")) is None:
        known = sets_known(run, states, scene_of(run, roots))
        yield from _space_parts([(start + round(1e9 * time_s), snapshot) for time_s, snapshot in known])
    elif (place := run.place_of(grid, roots)) is not None:
        yield start, 0, partial(_field, start, place / "field.npz" if place.is_dir() else place)
    robot = robot_of(run, states, roots)
    for link, body in robot_bodies(robot).items():
        yield start, 1, methodcaller("add_mesh", f"{MESHES}/{link}", start, link, body.vertices, body.faces)
    for state, stamp in enumerate(states.stamps_ns.tolist()):
        q = position_of(states, robot, state)
        poses = {link: robot.frame_pose(q, link) for link in robot.frame_names}
        clearance = {name: finite(float(values[state])) for name, values in states.clearance.items()}
        yield stamp, 2, methodcaller("add_transforms", TRANSFORMS, stamp, poses)
        yield stamp, 3, methodcaller("add_numbers", CLEARANCE, stamp, clearance)
    yield start, 4, methodcaller("add_line", EVENTS, start, "INFO", str(run.verdict.get("sentence", "")))
    for event in (run.json_of("events.json") or {}).get("events", []):
        if event["source"] in SHOWN:
            level = "INFO" if event["kind"] in INTERVENTIONS else "WARNING"
            words = f"{event['kind']}{SHOWN[event['source']]}: {event['worst_name']}, worst {event['worst']:.4g}"
            line = f"{words} {event['unit']} at {event['worst_s']:.2f} s, until {event['end_s']:.2f} s"
            yield int(event["first_ns"]), 4, methodcaller("add_line", EVENTS, int(event["first_ns"]), level, line)


def _space_parts(known: Sequence[tuple[int, Snapshot]]) -> Iterator[Later]:
    few = {known[i][0] for i in spread([1e-9 * (stamp - known[0][0]) for stamp, _ in known], math.inf)}
    for stamp, snapshot in known:
        yield stamp, 0, partial(_cloud, stamp, snapshot)
        if stamp in few:
            yield stamp, 0, partial(_space, stamp, snapshot)


def _cloud(stamp: int, snapshot: Snapshot, log: FoxgloveLog) -> None:
    splats = snapshot.splats()
    x, y, z = splats.centers.T
    shades = np.rint(255 * np.clip(np.column_stack([splats.colors, splats.opacities]), 0.0, 1.0))
    colors = dict(zip(("red", "green", "blue", "alpha"), shades.astype(np.uint8).T, strict=True))
    log.add_cloud(CLOUD, stamp, {"x": x, "y": y, "z": z, "radius": splats.radii, "label": splats.labels, **colors})


def _space(stamp: int, snapshot: Snapshot, log: FoxgloveLog) -> None:
    if (grid := snapshot.occupancy()) is not None:
        log.add_voxels(SPACE, stamp, "state", grid.states(FREE_BELOW, OCCUPIED_ABOVE), grid.origin, grid.voxel)


def _field(stamp: int, path: Path, log: FoxgloveLog) -> None:
    grid = read_npz(path)
    log.add_voxels(DISTANCE, stamp, "distance", np.asarray(grid.channels["sdf"]), grid.origin, grid.voxel)
