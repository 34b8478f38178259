"""The timeline of a report: curves, margin, strips and what is escaped in them."""

import re

import numpy as np
import pytest

from splatctrl_cli.report.timeline import HEIGHT, LEFT, RIGHT, TOP, WIDTH, legend, runs_of, timeline

SECONDS = np.linspace(0.0, 2.0, 5)


def points(svg: str, name: str) -> list[list[tuple[float, float]]]:
    """Of each piece of a curve."""
    lines = re.findall(rf'points="([^"]+)" data-name="{name}"', svg)
    return [[(float(x), float(y)) for x, y in (pair.split(",") for pair in line.split())] for line in lines]


def test_a_curve_runs_over_the_whole_axis_and_breaks_where_there_is_no_value() -> None:
    exact = np.array([0.04, 0.02, np.nan, 0.06, 0.08])
    svg = timeline(SECONDS, {"exact": exact}, 0.02, {})
    first, second = points(svg, "to the splats")
    assert first[0][0] == LEFT and second[-1][0] == WIDTH - RIGHT
    assert len(first) == len(second) == 2
    margin = float(re.search(r'class="margin" d="M\d+ ([\d.]+)', svg)[1])  # type: ignore[index]
    assert first[1][1] == pytest.approx(margin, abs=0.06)  # 2 cm, drawn to a tenth of a pixel
    assert second[1][1] < first[0][1] < margin  # more clearance is higher up


def test_contact_has_room_below_the_line_of_zero() -> None:
    svg = timeline(SECONDS, {"exact": np.linspace(0.05, -0.01, 5)}, 0.02, {})
    zero = float(re.search(r'class="contact" d="M\d+ ([\d.]+)', svg)[1])  # type: ignore[index]
    assert zero < points(svg, "to the splats")[0][-1][1] <= TOP + HEIGHT


def test_a_long_series_keeps_its_least_value() -> None:
    seconds, values = np.linspace(0, 100, 50_000), np.full(50_000, 0.1)
    values[31_234] = 0.001
    svg = timeline(seconds, {"exact": values}, 0.02, {})
    (line,) = points(svg, "to the splats")
    assert len(svg) < 60_000
    assert max(y for _, y in line) > TOP + 0.9 * HEIGHT


def test_events_and_rungs_are_strips_in_time() -> None:
    rungs = ("solved", "solved", "hold", "", "solved")
    svg = timeline(SECONDS, {"exact": np.full(5, 0.1)}, 0.02, {"below-margin": [(0.5, 1.0)], "none": []}, rungs)
    assert runs_of(rungs, SECONDS) == [("solved", 0.0, 1.0), ("hold", 1.0, 1.5), ("solved", 2.0, 2.0)]
    assert ">below-margin</text>" in svg and ">none</text>" not in svg
    assert "<title>below-margin, 0.50 to 1.00 s</title>" in svg
    assert "<title>hold, 1.00 to 1.50 s</title>" in svg


def test_names_are_no_markup() -> None:
    bad = "<b>&"
    svg = timeline(SECONDS, {bad: np.full(5, 0.1)}, 0.02, {bad: [(0.0, 1.0)]}, [bad] * 5)
    assert "<b>" not in svg


def test_the_legend_has_the_least_value_of_each_measure() -> None:
    rows = legend({"exact": np.array([0.0123, np.nan]), "truth": np.full(2, np.nan)})
    assert [row[1:] for row in rows] == [("to the splats", "least 12.3 mm"), ("truth", "no value")]
