"""``splatctrl sdf-bake``: a scene's splats as a distance grid, and its accuracy where the truth is known."""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_config,
    add_gates,
    add_output,
    check_gates,
    configured,
    table,
)
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError

if TYPE_CHECKING:
    from splatctrl_cli.config import FieldConfig
    from splatctrl_cli.evaluate.field_accuracy import FieldAccuracy
    from splatctrl_cli.records import Box, DistanceGrid, Label, OccupancyGrid, RgbdFrame, SplatSet

FORMATS = ("npz", "vti")
MAX_TRUTH_CELLS = 200_000  # a larger grid is compared with the truth at this many cells, drawn with the seed
POINTS_PER_CHUNK = 50_000  # of the truth's (points x primitives) arrays


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(
        subparsers, "sdf-bake", run, summary="bake a scene's splats into a distance grid with gradient"
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a folder that reconstruct wrote, or a splats.ply")
    add_output(parser, default="field", what="folder to write: field.npz, field.vti, field.json, run.json")
    parser.add_argument("--formats", default="npz,vti", metavar="NAME,...", help="npz, vti (default: both)")
    parser.add_argument("--at", type=float, metavar="SECONDS", help="the scene as known that long after its start")
    parser.add_argument(
        "--include",
        default="human",
        metavar="NAME,...",
        help="labels in the field beside object: robot, human, or none (default: human; the robot is left out)",
    )
    parser.add_argument(
        "--box", metavar="X0,Y0,Z0,X1,Y1,Z1", help="what the grid covers [m]; write --box=-1,... for a negative start"
    )
    parser.add_argument("--urdf", type=Path, help="cover the reach of this robot around its base, without --box")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its spheres (default: the URDF's own)")
    parser.add_argument("--voxel", type=float, metavar="M", help="cell size (field.voxel)")
    parser.add_argument("--length-scale", type=float, metavar="M", help="l of the kernel (field.length_scale)")
    parser.add_argument("--truth", type=Path, metavar="truth.json", help="measure the field against this truth")
    parser.add_argument(
        "--seen-by", type=Path, metavar="LOG", help="the log or capture whose cameras saw the scene, for --truth"
    )
    add_config(parser)
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.field.bake import bake
    from splatctrl_cli.io.output import Stopwatch, output_path, write_json, write_run

    console, stopwatch = Console(args), Stopwatch()
    formats, labels = _names(args.formats, FORMATS, "--formats"), _labels(args.include)
    if (args.truth is None) != (args.seen_by is None):
        raise UsageError("--truth and --seen-by: expected both or neither")
    config = configured(args)
    config = replace(config, field=_field_config(config.field, args))
    out = args.out or Path("field")
    with output_path(out, force=args.force, is_folder=True) as partial:
        with stopwatch.stage("read"):
            source = _read_scene(args.scene, args.at)
        box = _box(args, source.splats, labels, config.field.padding)
        with stopwatch.stage("bake"):
            grid = bake(
                source.splats,
                box,
                config.field,
                occupancy=source.occupancy,
                thresholds=config.occupancy,
                labels=labels,
                threads=args.threads,
            )
        grid.header["digests"] = source.digests
        grid.header["stamp_ns"] = source.stamp_ns
        for warning in _warnings(grid):
            console.log(f"warning: {warning}")
        with stopwatch.stage("write"):
            _write(partial, grid, formats)
        result = _summary(grid)
        lines = table(("field", ""), [(name.replace("_", " "), _shown(value)) for name, value in result.items()])
        if args.truth is not None:
            with stopwatch.stage("accuracy"):
                accuracy = _accuracy(grid, source, args.truth, args.seen_by, seed=args.seed)
            write_json(partial / "accuracy.json", accuracy.as_dict())
            result["accuracy"] = accuracy.as_dict()
            lines += ["", *_accuracy_lines(accuracy)]
        metrics = _metrics(result)
        write_run(
            partial,
            command="sdf-bake",
            config=config.as_dict(),
            inputs=source.digests,
            metrics=metrics,
            stopwatch=stopwatch,
            seed=args.seed,
        )
    console.log(f"baked in {stopwatch.seconds['bake']:.2f} s; wrote {out}")
    console.result(result, lines)
    check_gates(args.require, metrics)
    return 0


@dataclass(frozen=True, kw_only=True)
class _Source:
    """What is baked: splats, the occupancy of the same moment where there is one, and where they come from."""

    splats: "SplatSet"
    occupancy: "OccupancyGrid | None"
    stamp_ns: int | None
    cameras: tuple[str, ...] | None
    digests: dict[str, str]


def _read_scene(path: Path, at_seconds: float | None) -> _Source:
    from splatctrl_cli.io.output import sha256
    from splatctrl_cli.io.splats import read_ply

    if not path.exists():
        raise InputError(f"{path}: no such file or folder", remedy="give what reconstruct wrote, or a splats.ply")
    if path.is_dir():
        return _read_folder(path, at_seconds)
    if at_seconds is not None:
        raise UsageError(f"--at {at_seconds:g}: {path} is one splat set", remedy="give the scene's folder")
    splats, _ = read_ply(path)
    return _Source(splats=splats, occupancy=None, stamp_ns=None, cameras=None, digests={path.name: sha256(path)})


def _read_folder(path: Path, at_seconds: float | None) -> _Source:
    from splatctrl_cli.io.output import sha256
    from splatctrl_cli.io.scene_folder import open_scene

    scene = open_scene(path)
    if at_seconds is None:
        splats, occupancy, stamp_ns = scene.splats(), scene.occupancy(), scene.stamp_ns
        files = [path / "splats.ply", path / "occupancy.npz"]
    else:
        if not scene.snapshots:
            raise NotEvaluableError(f"{path}: has no snapshots", remedy="bake without --at")
        wanted_ns = scene.snapshots[0].stamp_ns + round(at_seconds * 1e9)
        splats, occupancy = scene.splats_at(wanted_ns), None  # the occupancy on disk is that of the end
        snapshot = max((s for s in scene.snapshots if s.stamp_ns <= wanted_ns), key=lambda s: s.stamp_ns)
        stamp_ns, files = snapshot.stamp_ns, [snapshot.path]
    return _Source(
        splats=splats,
        occupancy=occupancy,
        stamp_ns=stamp_ns,
        cameras=scene.cameras,
        digests={file.name: sha256(file) for file in files},
    )


def _names(text: str, choices: tuple[str, ...], option: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    unknown = [name for name in names if name not in choices]
    if unknown or not names:
        raise UsageError(f"{option} {text}: expected some of: {', '.join(choices)}")
    return names


def _labels(text: str) -> "frozenset[Label]":
    from splatctrl_cli.records import Label

    if text.strip() == "none":
        return frozenset({Label.OBJECT})
    names = _names(text, ("robot", "human"), "--include")
    return frozenset({Label.OBJECT, *(Label[name.upper()] for name in names)})


def _field_config(config: "FieldConfig", args: argparse.Namespace) -> "FieldConfig":
    given = {"voxel": args.voxel, "length_scale": args.length_scale}
    return replace(config, **{name: value for name, value in given.items() if value is not None})


def _box(args: argparse.Namespace, splats: "SplatSet", labels: "frozenset[Label]", padding: float) -> "Box":
    import numpy as np

    from splatctrl_cli.field.bake import bounding_box
    from splatctrl_cli.field.selection import field_splats
    from splatctrl_cli.records import Box

    if args.box is not None:
        try:
            numbers = np.array([float(text) for text in args.box.split(",")])
        except ValueError:
            raise UsageError(f"--box {args.box}: expected six numbers x0,y0,z0,x1,y1,z1") from None
        if numbers.shape != (6,):
            raise UsageError(f"--box {args.box}: expected six numbers x0,y0,z0,x1,y1,z1, got {len(numbers)}")
        return Box(lower=numbers[:3], upper=numbers[3:])
    if args.urdf is not None:
        from splatctrl_cli.robot.model import RobotModel

        robot = RobotModel.from_urdf(args.urdf, args.spheres)
        return Box(lower=robot.base_position - robot.reach(), upper=robot.base_position + robot.reach())
    return bounding_box(field_splats(splats, labels), padding)


def _write(folder: Path, grid: "DistanceGrid", formats: tuple[str, ...]) -> None:
    from splatctrl_cli.io.grid import write_npz, write_vti
    from splatctrl_cli.io.output import write_json

    if "npz" in formats:
        write_npz(folder / "field.npz", grid)
    if "vti" in formats:
        write_vti(folder / "field.vti", grid)
    place = {"shape": grid.channels["sdf"].shape, "first_cell": grid.origin, "voxel": grid.voxel}
    write_json(folder / "field.json", {**grid.header, **place})


def _warnings(grid: "DistanceGrid") -> tuple[str, ...]:
    health = grid.header["health"]
    assert isinstance(health, dict)
    return tuple(health["warnings"])


def _summary(grid: "DistanceGrid") -> dict[str, Any]:
    import numpy as np

    observed, used = grid.channels["observed"], grid.header["splats_used"]
    health = grid.header["health"]
    assert isinstance(used, dict) and isinstance(health, dict)
    return {
        "num_splats": sum(used.values()),
        "num_splats_left_out": sum(dict(grid.header["splats_given"]).values()) - sum(used.values()),  # type: ignore[call-overload]
        "shape": list(observed.shape),
        "num_cells": observed.size,
        "voxel": grid.voxel,
        "length_scale": grid.header["length_scale"],
        "median_radius": health["radius"],
        "median_spacing": health["spacing"],
        "never_seen_share": float(np.mean(observed == 0)),
        "num_warnings": len(health["warnings"]),
    }


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return " x ".join(map(str, value)) if isinstance(value, list) else str(value)


def _accuracy(grid: "DistanceGrid", source: _Source, truth_path: Path, log: Path, *, seed: int) -> "FieldAccuracy":
    import numpy as np

    from splatctrl_cli.evaluate.field_accuracy import BANDS, field_accuracy
    from splatctrl_cli.evaluate.visibility import seen_by
    from splatctrl_cli.simulate.truth import load_truth

    truth = load_truth(truth_path)
    stamp_ns = int(truth.stamps[-1]) if source.stamp_ns is None else source.stamp_ns
    shape = grid.channels["sdf"].shape
    num_cells = int(np.prod(shape))
    drawn = np.random.default_rng(seed).choice(num_cells, min(num_cells, MAX_TRUTH_CELLS), replace=False)
    near_cells, distances, surface = [], [], []
    for cells in np.array_split(np.sort(drawn), -(-len(drawn) // POINTS_PER_CHUNK)):
        points = grid.origin + grid.voxel * np.stack(np.unravel_index(cells, shape), axis=1)
        distance, closest = truth.closest(points, stamp_ns)
        is_near = (distance >= BANDS[0][0]) & (distance < BANDS[-1][1])
        near_cells.append(cells[is_near])
        distances.append(distance[is_near])
        surface.append(closest[is_near])
    cells, surface_points = np.concatenate(near_cells), np.concatenate(surface)
    if not len(cells):
        raise NotEvaluableError(f"{truth_path}: no cell of the grid lies within {BANDS[-1][1]} m of an object")
    seen = np.zeros(len(cells), dtype=np.bool_)
    for frame in _frames(log, source.cameras, stamp_ns):
        unseen = np.flatnonzero(~seen)
        seen[unseen] = seen_by(surface_points[unseen], [frame])
    fields = {name: grid.channels[name].reshape(-1)[cells].astype(np.float64) for name in ("hard", "gpdf")}
    health: Any = grid.header["health"]
    return field_accuracy(fields, np.concatenate(distances), seen, median_radius=health["radius"])


def _frames(log: Path, cameras: tuple[str, ...] | None, until_ns: int) -> "Iterator[RgbdFrame]":
    """Frames of the scene's training cameras (of every camera for a bare splat set), up to its stamp."""
    from splatctrl_cli.io.source import open_source
    from splatctrl_cli.records import RgbdFrame

    for record in open_source(log).records():
        if record.stamp_ns > until_ns:
            return
        if isinstance(record, RgbdFrame) and (cameras is None or record.camera in cameras):
            yield record


def _accuracy_lines(accuracy: "FieldAccuracy") -> list[str]:
    header = ("points", "field", "true cm", "cells", "mean", "rmse", "median", "95 %", "max over [mm]")
    rows: list[tuple[object, ...]] = []
    for where, fields in (("all", accuracy.everywhere), ("seen", accuracy.seen)):
        for name, bands in fields.items():
            for band in bands:
                values = (band.mean, band.rmse, band.median, band.over_95, band.over_max)
                shown = ["-" if value is None else f"{value * 1e3:.1f}" for value in values]
                rows.append((where, name, f"{band.lower * 100:g}-{band.upper * 100:g}", band.count, *shown))
    over = accuracy.over_estimate
    verdict = (
        f"hard exceeds the truth by more than {over.allowance * 1e3:.1f} mm at {over.count_beyond} of {over.count} "
        f"seen cells"
    )
    if over.median_beyond is not None and over.max_error is not None:
        verdict += (
            f", there by {over.median_beyond * 1e3:.1f} mm more in the median, {over.max_error * 1e3:.1f} mm at most"
        )
    return [*table(header, rows), verdict]


def _metrics(result: Mapping[str, Any]) -> dict[str, float | None]:
    """Numbers a gate can name: those of the summary, ``seen.hard.0_2cm.rmse`` and so on, ``over_estimate.*``."""
    metrics: dict[str, float | None] = {
        name: value for name, value in result.items() if isinstance(value, int | float)
    }
    accuracy = result.get("accuracy")
    if accuracy is None:
        return metrics
    for where in ("everywhere", "seen"):
        for field, bands in accuracy[where].items():
            for band in bands:
                place = f"{where}.{field}.{band['lower'] * 100:g}_{band['upper'] * 100:g}cm"
                metrics |= {f"{place}.{name}": band[name] for name in band if name not in {"lower", "upper"}}
    return metrics | {f"over_estimate.{name}": value for name, value in accuracy["over_estimate"].items()}
