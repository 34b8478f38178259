"""The timeline of a report, and the scene beside it: curves, margin, strips, escapes; bodies and numbers."""

import base64
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import Label
from splatctrl_cli.report.page import Space, bodies_of, coarsen, pack, three_js
from splatctrl_cli.report.timeline import HEIGHT, LEFT, RIGHT, TOP, WIDTH, legend, runs_of, timeline
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import Shape
from tests.plain import plain_splats
from tests.refused import expect_refusal

SECONDS = np.linspace(0.0, 2.0, 5)


def points(svg: str, name: str) -> list[list[tuple[float, float]]]:
    """Of each piece of a curve."""
    lines = re.findall(rf'points="([^"]+)" data-name="{name}"', svg)
    return [[(float(x), float(y)) for x, y in (pair.split(",") for pair in line.split())] for line in lines]


def test_a_curve_runs_over_the_whole_axis_and_breaks_where_there_is_no_value() -> None:
    svg = timeline(SECONDS, {"exact": np.array([0.04, 0.02, np.nan, 0.06, 0.08])}, 0.02, {})
    first, second = points(svg, "to the splats")
    assert first[0][0] == LEFT and second[-1][0] == WIDTH - RIGHT
    assert len(first) == len(second) == 2
    margin = float(re.search(r'class="margin" d="M\d+ ([\d.]+)', svg)[1])  # type: ignore[index]
    assert first[1][1] == pytest.approx(margin, abs=0.06)  # 2 cm, drawn to a tenth of a pixel
    assert second[1][1] < first[0][1] < margin  # more clearance is higher up
    svg = timeline(SECONDS, {"exact": np.linspace(0.05, -0.01, 5)}, 0.02, {})
    zero = float(re.search(r'class="contact" d="M\d+ ([\d.]+)', svg)[1])  # type: ignore[index]
    assert zero < points(svg, "to the splats")[0][-1][1] <= TOP + HEIGHT  # contact has room below


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
    assert "<b>" not in timeline(SECONDS, {bad: np.full(5, 0.1)}, 0.02, {bad: [(0.0, 1.0)]}, [bad] * 5)


def test_the_legend_has_the_least_value_of_each_measure() -> None:
    rows = legend({"exact": np.array([0.0123, np.nan]), "truth": np.full(2, np.nan)})
    assert [row[1:] for row in rows] == [("to the splats", "least 12.3 mm"), ("truth", "no value")]


@pytest.mark.parametrize(
    ("kind", "size", "extents"),
    [
        ("box", (0.2, 0.4, 0.6), (0.2, 0.4, 0.6)),
        ("cylinder", (0.1, 0.5), (0.2, 0.2, 0.5)),
        ("sphere", (0.3,), (0.6, 0.6, 0.6)),
        ("capsule", (0.1, 0.5), (0.2, 0.2, 0.7)),
    ],
)
def test_a_primitive_is_drawn_in_its_place_and_size(
    kind: str, size: tuple[float, ...], extents: tuple[float, ...]
) -> None:
    shape = Shape(link="hand", kind=kind, size=size, T_link_shape=pose_at([1.0, 2.0, 3.0]))
    vertices = bodies_of(RobotSurface.from_parts([shape]))["hand"].vertices
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose(upper - lower, extents, rtol=0.02)
    np.testing.assert_allclose((upper + lower) / 2, [1.0, 2.0, 3.0], atol=1e-3)


def test_unknown_space_is_its_border_and_in_larger_cubes_where_that_is_too_much() -> None:
    is_unknown = np.zeros((40, 40, 40), bool)
    is_unknown[10:30, 10:30, 10:30] = True
    fine, edge = coarsen(is_unknown, np.zeros(3), 0.1, 10_000)
    assert (len(fine), edge) == (20**3 - 18**3, 0.1)
    coarse, edge = coarsen(is_unknown, np.zeros(3), 0.1, 500)
    assert (len(coarse), edge) == (10**3 - 8**3, pytest.approx(0.2))
    np.testing.assert_allclose(coarse.min(axis=0) - edge / 2, 10 * 0.1 - 0.05, atol=1e-6)  # the same lower corner
    assert len(coarsen(np.ones((5, 5, 5), bool), np.zeros(3), 0.1, 100)[0]) == 0  # there is none around the grid


def test_splats_are_packed_to_a_hundredth_of_a_per_cent_of_their_box() -> None:
    generator = np.random.default_rng(0)
    centers = generator.uniform(-1.5, 1.5, (200, 3))
    labels = np.where(np.arange(200) < 50, Label.ROBOT, Label.OBJECT)
    splats = plain_splats(centers, generator.uniform(0.002, 0.05, 200), labels=labels)
    scene = json.loads(pack(Space(splats={0.0: splats})))
    block, (coded,) = zlib.decompress(base64.b64decode(scene["bytes"])), scene["header"]["splats"]
    kind, start, count = coded["centers"]["array"]
    whole = np.frombuffer(block, kind, count, start).reshape(3, -1).T
    np.testing.assert_allclose(whole * coded["centers"]["step"] + coded["centers"]["lower"], centers, atol=3e-5)
    kind, start, count = coded["radii"]
    radii = np.frombuffer(block, kind, count, start) * coded["largest"] / 65535
    np.testing.assert_allclose(radii, splats.radii, atol=1e-6)
    assert len(pack(Space(splats={0.0: splats}))) < 6000


def test_without_the_three_js_of_trimesh_the_remedy_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert b"THREE" in zlib.decompress(base64.b64decode(three_js()))
    monkeypatch.setattr(trimesh.resources, "get_bytes", lambda name: Path(name).read_bytes())
    expect_refusal(r"three.js: not found in trimesh.*pip install 'trimesh", three_js, error=UsageError)
