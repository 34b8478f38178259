"""``splatctrl sdf-bake``: a scene's splats as a distance grid, and its accuracy where the truth is known."""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_config,
    add_gates,
    add_output,
    check_gate_names,
    check_gates,
    configured,
    table,
)
from splatctrl_cli.errors import UsageError

if TYPE_CHECKING:
    from splatctrl_cli.config import FieldConfig
    from splatctrl_cli.records import Box, DistanceGrid, Label, SplatSet

FORMATS = ("npz", "vti")
SUMMARY_METRICS = (
    *("num_splats", "num_splats_left_out", "num_cells", "voxel", "length_scale", "median_radius", "median_spacing"),
    *("never_seen_share", "num_warnings"),
)


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
    from splatctrl_cli.cli.bake_source import read_bake_source
    from splatctrl_cli.cli.field_truth import accuracy_lines, compare_with_truth
    from splatctrl_cli.field.bake import bake
    from splatctrl_cli.io.output import Stopwatch, output_path, write_json, write_run

    console, stopwatch = Console(args), Stopwatch()
    formats, labels = _names(args.formats, FORMATS, "--formats"), _labels(args.include)
    if (args.truth is None) != (args.seen_by is None):
        raise UsageError("--truth and --seen-by: expected both or neither")
    check_gate_names(args.require, _metric_names(with_truth=args.truth is not None))
    config = configured(args)
    config = replace(config, field=_field_config(config.field, args))
    out = args.out or Path("field")
    with output_path(out, force=args.force, is_folder=True) as partial:
        with stopwatch.stage("read"):
            source = read_bake_source(args.scene, args.at)
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
        warnings = _warnings(grid, has_occupancy=source.occupancy is not None)
        for warning in warnings:
            console.log(f"warning: {warning}")
        with stopwatch.stage("write"):
            _write(partial, grid, formats)
        result = _summary(grid, len(warnings))
        lines = table(("field", ""), [(name.replace("_", " "), _shown(value)) for name, value in result.items()])
        if args.truth is not None:
            with stopwatch.stage("accuracy"):
                compared = compare_with_truth(grid, source, args.truth, args.seen_by, seed=args.seed)
            write_json(partial / "accuracy.json", compared.as_dict())
            result["accuracy"] = compared.as_dict()
            lines += ["", *accuracy_lines(compared)]
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

    from splatctrl_cli.field.layout import bounding_box
    from splatctrl_cli.field.selection import field_splats
    from splatctrl_cli.records import Box

    if args.box is not None:
        try:
            numbers = np.array([float(text) for text in args.box.split(",")])
        except ValueError:
            raise UsageError(f"--box {args.box}: expected six numbers x0,y0,z0,x1,y1,z1") from None
        if numbers.shape != (6,):
            raise UsageError(f"--box {args.box}: expected six numbers x0,y0,z0,x1,y1,z1, got {len(numbers)}")
        if not (np.isfinite(numbers).all() and (numbers[:3] < numbers[3:]).all()):
            raise UsageError(
                f"--box {args.box}: expected x0 < x1, y0 < y1, z0 < z1", remedy="give the lower corner first"
            )
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


def _warnings(grid: "DistanceGrid", *, has_occupancy: bool) -> tuple[str, ...]:
    health = grid.header["health"]
    assert isinstance(health, dict)
    if has_occupancy and not grid.channels["observed"].any():
        return (*health["warnings"], "no cell of the grid was ever seen by a camera; check --box")
    return tuple(health["warnings"])


def _summary(grid: "DistanceGrid", num_warnings: int) -> dict[str, Any]:
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
        "num_warnings": num_warnings,
    }


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return " x ".join(map(str, value)) if isinstance(value, list) else str(value)


def _metric_names(*, with_truth: bool) -> tuple[str, ...]:
    """The names of `_metrics`, known before anything is baked."""
    from splatctrl_cli.cli.field_truth import FIELDS
    from splatctrl_cli.evaluate.field_accuracy import metric_names

    return (*SUMMARY_METRICS, *(metric_names(FIELDS) if with_truth else ()))


def _metrics(result: Mapping[str, Any]) -> dict[str, float | None]:
    """Numbers a gate can name: those of the summary, ``seen.hard.0_2cm.rmse`` and so on, ``over_estimate.*``."""
    from splatctrl_cli.evaluate.field_accuracy import band_name

    metrics: dict[str, float | None] = {name: result[name] for name in SUMMARY_METRICS}
    accuracy = result.get("accuracy")
    if accuracy is None:
        return metrics
    for where in ("everywhere", "seen"):
        for field, bands in accuracy[where].items():
            for band in bands:
                place = f"{where}.{field}.{band_name(band['lower'], band['upper'])}"
                metrics |= {f"{place}.{name}": band[name] for name in band if name not in {"lower", "upper"}}
    return metrics | {f"over_estimate.{name}": value for name, value in accuracy["over_estimate"].items()}
