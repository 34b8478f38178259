"""``score`` of several scans at once: a folder of scenes, each named like its scan, and the mean over the scans."""

import argparse
import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.common import Console, table
from splatctrl_cli.cli.score_baseline import PREFIX, change_cells, changes, read_baseline
from splatctrl_cli.cli.score_reference import words
from splatctrl_cli.cli.score_report import COLUMNS, cell, cloud_lines, protocol_lines, score_verdict, with_change
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.files.output import Stopwatch, write_json, write_run

if TYPE_CHECKING:
    ScoreScene = Callable[[argparse.Namespace, Console, Path | None], tuple[dict[str, Any], Verdict]]

SUMS = ("num_views", "num_skipped", "num_warnings", "num_points", "num_reference")


def scenes_of_scans(args: argparse.Namespace) -> dict[str, Path]:
    """The scenes by scan where SCENE is a folder of them; empty where it is one scene, or nothing with --dtu.

    Raises InputError naming a scan of --scan that has none.
    """
    if args.dtu is None or not args.scene.is_dir() or (args.scene / "splats.ply").is_file():
        return {}
    found = {path.name: path for path in sorted(args.scene.iterdir()) if (path / "splats.ply").is_file()}
    if not found or args.scan is None:
        return found
    wanted = list(dict.fromkeys(words(args.scan)))
    missing = [name for name in wanted if name not in found]
    if missing:
        raise InputError(f"{args.scene}: no scene '{missing[0]}'", remedy=f"scenes: {', '.join(found)}")
    return {name: found[name] for name in wanted}


def score_scans(
    args: argparse.Namespace,
    console: Console,
    scenes: Mapping[str, Path],
    score_scene: "ScoreScene",
    folder: Path | None,
) -> "tuple[dict[str, Any], Verdict]":
    """Score every scene against its scan; returns what --json prints, and the verdict, on the means.

    Masks are those of DIR/SCAN; `folder` gets a folder for each scan, and the means.
    """
    results: dict[str, dict[str, Any]] = {}
    is_damaged = False
    for scan, scene in scenes.items():
        console.log(f"{scan}: scores {scene}")
        place = None if folder is None else folder / scan
        if place is not None:
            place.mkdir()
        masks = None if args.masks is None else masks_of_scan(args.masks, scan)
        of_scan = {"scene": scene, "scan": scan, "masks": masks}
        of_scan |= {"require": [], "baseline": None}  # which the means alone are held to
        scoring = argparse.Namespace(**{**vars(args), **of_scan})
        results[scan], verdict = score_scene(scoring, console, place)
        is_damaged |= verdict.is_damaged
    result = result_of_scans(args, results)
    if args.baseline is not None:
        result["metrics"] |= changes(result, read_baseline(args.baseline), args.baseline)
    verdict = score_verdict(result, args.require, is_damaged=is_damaged)
    if folder is not None:
        _write(folder, result, verdict)
    return result, verdict


def masks_of_scan(folder: Path, scan: str) -> Path:
    """DIR/SCAN. Raises InputError where there is none: the masks of one scan fit no other."""
    if not (folder / scan).is_dir():
        raise InputError(f"{folder}: expected a folder {scan} with this scan's masks, got none")
    return folder / scan


def result_of_scans(args: argparse.Namespace, results: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """The means over the scans of what each scan's `results` hold; a figure that one of them lacks is None."""
    each = [result["metrics"] for result in results.values()]
    metrics = {}
    for name in each[0]:
        values = [one.get(name) for one in each]
        known = [value for value in values if value is not None]
        total = sum(known) if len(known) == len(values) else None
        metrics[name] = total if total is None or name in SUMS else total / len(values)
    protocols = [result["protocol"] for result in results.values()]
    averaging = "mean over the views of a scan, then over the scans"
    warnings = [f"{scan}: {line}" for scan, result in results.items() for line in result["warnings"]]
    return {
        "scenes": str(args.scene),
        "reference": str(args.dtu),
        "scans": list(results),
        "protocol": _common(protocols) | {"averaging": averaging},
        "metrics": metrics | {"num_scans": len(results)},
        "warnings": [*warnings, *_other_scans(protocols[0], list(results))],
        "results": dict(results),
    }


def _common(protocols: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the scans were scored by: where they differ, each of it."""
    first = protocols[0]
    common = {}
    for name, value in first.items():
        others = list(dict.fromkeys(str(protocol[name]) for protocol in protocols))
        common[name] = value if len(others) == 1 else " | ".join(others)
    sizes = [size for protocol in protocols for size in protocol["resolution"]]
    return common | {"resolution": sorted(set(sizes)), "background": first["background"]}


def _other_scans(protocol: dict[str, Any], scans: Sequence[str]) -> list[str]:
    """In words, how these scans differ from those of the published mean."""
    published = protocol["published_scans"]
    missing = [number for number in published or () if f"scan{number}" not in scans]
    others = [name for name in scans if name not in {f"scan{number}" for number in published or ()}]
    if not published or not (missing or others):
        return []
    parts = [f"lacks scans {', '.join(map(str, missing))}"] if missing else []
    parts += [f"has {', '.join(others)} more"] if others else []
    return [f"{protocol['name']}: this mean {' and '.join(parts)}; the published one is of {len(published)} scans"]


def lines_of_scans(result: dict[str, Any]) -> list[str]:
    """A row for each scan, their mean, and what belongs to the figures."""
    metrics, results = result["metrics"], result["results"]
    columns = [name for name in COLUMNS if name in metrics]
    rows = [
        [scan, one["metrics"]["num_views"], *(cell(name, one["metrics"].get(name)) for name in columns)]
        for scan, one in results.items()
    ]
    last = [f"mean of {len(results)}", metrics["num_views"], *(cell(name, metrics[name]) for name in columns)]
    changed = ["change", "-", *change_cells(columns, metrics)]
    lines = table(
        ("scan", "views", *(COLUMNS[name] for name in columns)), with_change([*rows, last], changed, metrics)
    )
    lines.insert(2 + len(rows), lines[1])
    lines += ["", *protocol_lines(result["protocol"])]
    if "chamfer" in metrics:
        lines += cloud_lines(metrics, "; ".join(one["protocol"]["definitions"]["cloud"] for one in results.values()))
    return lines


def _write(folder: Path, result: dict[str, Any], verdict: "Verdict") -> None:
    write_json(folder / "score.json", result)
    with (folder / "scans.csv").open("w", newline="", encoding="utf-8") as stream:
        names = [name for name in result["metrics"] if name != "num_scans" and not name.startswith(PREFIX)]
        rows = csv.DictWriter(stream, fieldnames=["scan", *names], lineterminator="\n", extrasaction="ignore")
        rows.writeheader()
        rows.writerows({"scan": scan, **one["metrics"]} for scan, one in result["results"].items())
    write_run(
        folder,
        command="score",
        config={"scans": result["scans"]},
        inputs={},
        metrics=result["metrics"],
        stopwatch=Stopwatch(),
        verdict=verdict.as_dict(),
    )
