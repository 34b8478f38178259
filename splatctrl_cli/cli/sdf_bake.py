"""``splatctrl sdf-bake``: splats as a distance grid, with its accuracy."""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from splatctrl_cli.cli.common import Console, format_cell, names_of, request_of, table
from splatctrl_cli.config import fixed
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.jobs.bake.bake import bake
from splatctrl_cli.jobs.bake.request import BakeRequest
from splatctrl_cli.records import Label

ERRORS = ("mean", "rmse", "over_95", "over_max")
Band = Mapping[str, Any]
"""Errors in a band of true distance, as in ``field.json``."""

COLUMNS = ("count", "mean mm", "rmse mm", "95 % mm", "max mm")


def run(args: argparse.Namespace, console: Console) -> int:
    result = bake(request_of(BakeRequest, args), console)
    console.log(f"baked in {result.seconds['bake']:.2f} s; wrote {result.out}")
    return console.show(result, _lines(result))


def _lines(result: Result) -> Iterator[str]:
    accuracy = result.document.get("accuracy", {})
    summary = {name: value for name, value in result.document.items() if name != "accuracy"}
    values = {**summary, "shape": " x ".join(map(str, summary["shape"]))}
    yield from table(("field", ""), [(name.replace("_", " "), format_cell(value)) for name, value in values.items()])
    truth, mesh, held_out = (accuracy.get(name) for name in ("truth", "reference_mesh", "held_out_depth"))
    yield from () if truth is None else ("", *_truth_lines(truth))
    if mesh is not None:
        cells = [(name, _band(band), *_errors(band)) for name, band in _each(mesh["everywhere"])]
        yield from ("", *table(("field", "from mesh cm", *COLUMNS), cells))
    if held_out is not None:
        note = "before it: points whose ball up to it was seen to be free"
        places = {name: [("on it", band)] for name, band in held_out["on_surface"].items()}
        for name, band in _each(held_out["before"]["seen"]):
            places[name].append((_band(band), band))
        cells = [(name, place, *_errors(band)) for name, bands in places.items() for place, band in bands]
        titled = f"held-out depth of {held_out['num_frames']} frames; {note}"
        yield from ("", titled, *table(("field", "from depth cm", *COLUMNS), cells))


def _truth_lines(compared: Mapping[str, Any]) -> list[str]:
    figures, over = ("mean", "rmse", "median", "over_95", "over_max"), compared["over_estimate"]
    rows = [
        (where, name, _band(band), *_errors(band, figures))
        for where, place in (("seen", "seen"), ("all", "everywhere"))
        for name, band in _each(compared[place])
    ]
    beyond = ""
    if over["median_beyond"] is not None and over["max_error"] is not None:
        beyond = (
            f": in the median by {over['median_beyond'] * 1e3:.1f} mm more than that; "
            f"the largest error is {over['max_error'] * 1e3:.1f} mm"
        )
    outside = compared["num_outside_workspace"]
    verdict = (
        f"hard exceeds the truth by more than {over['allowance'] * 1e3:.1f} mm at {over['count_beyond']} of "
        f"{over['count']} seen cells{beyond}"
        + (f"; {outside} cells before seen surfaces outside the workspace do not count" if outside else "")
    )
    expected = [
        f"probability, {name}: calibration error {curve['calibration_error']:.3f} at seen cells"
        for name, curve in compared["reliability"].items()
    ]
    mean, sigma = compared["error_mean"], compared["error_sigma"]
    if mean is not None and sigma:
        expected.append(
            f"within {fixed.PROBABILITY_NEAR * 100:g} cm of seen surfaces sdf errs by {mean * 1e3:.1f} +- "
            f"{sigma * 1e3:.1f} mm: calibrate the probability with --set "
            f"field.error_mean={mean:.4f} --set field.error={sigma:.4f}"
        )
    return [
        "error = field - truth, positive where clearance is over-estimated",
        *table(("cells", "field", "true cm", *COLUMNS[:3], "median mm", *COLUMNS[3:]), rows),
        "seen: cells whose nearest true surface a camera saw; all: also those before backs that none saw",
        verdict,
        *expected,
    ]


def _each(fields: Mapping[str, Iterable[Band]]) -> Iterator[tuple[str, Band]]:
    return ((name, band) for name, bands in fields.items() for band in bands)


def _band(band: Band) -> str:
    return f"{band['lower'] * 100:g}-{band['upper'] * 100:g}"


def _errors(band: Band, figures: Sequence[str] = ERRORS) -> list[object]:
    """Count and errors [mm]."""
    values = (band[name] for name in figures)
    return [band["count"], *("-" if value is None else f"{value * 1e3:.1f}" for value in values)]


def labels_of(text: str) -> frozenset[Label]:
    """Labels in a field: objects, and ``--include``'s. Raises UsageError for other labels."""
    names = () if text.strip() == "none" else names_of("--include", ("robot", "human"), text)
    return frozenset({Label.OBJECT, *(Label[name.upper()] for name in names)})
