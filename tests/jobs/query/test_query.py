"""Answers about points: what a scene, a grid, and both say, beside the fields themselves."""

import csv
import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import Config, FieldConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField, field_over, march
from splatctrl_cli.field.grid_cells import GridField
from splatctrl_cli.formats import ply
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.query.query import TITLES, QueryRequest, query
from splatctrl_cli.records import Float64, Label
from tests.cli.replay_desk import splats_of, write_scene
from tests.jobs.bake.baked import baked
from tests.recording.log.make_states import START_NS
from tests.refused import expect_refusal

BALLS = (((0.0, 0.0, 0.0), 0.10), ((0.5, 0.0, 0.0), 0.05))
POINTS = np.array([[0.0, 0.0, 0.25], [0.5, 0.0, 0.2], [0.0, 0.0, 0.02], [0.25, 0.3, -0.2], [9.0, 0.0, 0.0]])
HARD = replace(Config(), field=FieldConfig(distance="hard"))
BOX = (-0.4, -0.4, -0.4, 0.9, 0.4, 0.4)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    people = replace(splats_of(*BALLS), labels=np.array([Label.OBJECT, Label.HUMAN], np.uint8))
    return write_scene(tmp_path / "scene", (START_NS, people))


def query_points(source: Path, points: Float64 = POINTS, **options: object) -> tuple[Result, list[dict[str, str]]]:
    out = source.parent / "answers.csv"
    text = "x,y,z\n" + "".join(f"{x},{y},{z}\n" for x, y, z in points)
    given = {"source": source, "points": io.StringIO(text), "out": out, "force": True, **options}
    result = query(QueryRequest(**given))  # type: ignore[arg-type]
    with out.open(newline="") as stream:
        rows = [*csv.DictReader(stream)]
    assert tuple(rows[0]) == TITLES
    return result, rows


def column(rows: list[dict[str, str]], *names: str) -> Float64:
    return np.array([[float(row[name] or math.nan) for name in names] for row in rows])


def test_a_scene_answers_with_its_field_its_nearest_splat_and_the_surface(scene: Path) -> None:
    result, rows = query_points(scene)
    centers, radii = np.array([ball[0] for ball in BALLS]), np.array([ball[1] for ball in BALLS])
    field, exact = field_over(Spheres.of(centers, radii), FieldConfig()), SphereField(Spheres.of(centers, radii))
    distance, gradient = field.query(POINTS)
    surface, rest, _ = march(field, exact, POINTS)
    assert column(rows, "distance")[:, 0] == pytest.approx(distance, abs=1e-6)
    assert column(rows, "gradient_x", "gradient_y", "gradient_z") == pytest.approx(gradient, abs=1e-5)
    assert column(rows, "surface_x", "surface_y", "surface_z") == pytest.approx(surface, abs=1e-6)
    assert column(rows, "surface_rest")[:, 0] == pytest.approx(rest, abs=1e-6)
    assert [(row["label"], row["splat"]) for row in rows[:3]] == [("object", "0"), ("human", "1"), ("object", "0")]
    assert {row["observed"] for row in rows[:4]} == {"free"} and rows[4]["observed"] == "never_seen"
    figures = {"num_points": 5, "num_never_seen": 1, "num_in_collision": 1}
    figures |= {"min_distance": pytest.approx(distance.min(), abs=1e-6)}
    assert {name: result.metrics[name] for name in figures} == figures and result.document["source"] == "scene"


def test_the_bound_of_a_scene_is_never_above_the_exact_distance_and_hardly_below(scene: Path) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    _, rows = query_points(scene, points)
    exact = np.min([np.linalg.norm(points - np.array(c), axis=1) - r for c, r in BALLS], axis=0)
    bound = column(rows, "bound")[:, 0]
    assert (bound <= exact).all() and (bound >= exact - 1e-5).all()


def test_the_probability_is_that_of_the_distance_and_a_label_that_is_left_out_is_not_near(scene: Path) -> None:
    _, rows = query_points(scene, config=HARD)
    assert column(rows, "probability")[[2, 0], 0] == pytest.approx([1.0, 0.0], abs=1e-6)
    _, rows = query_points(scene, labels=frozenset({Label.OBJECT}))
    assert {row["label"] for row in rows} == {"object"} and float(rows[1]["distance"]) > 0.4


def test_an_occupied_voxel_without_a_splat_is_an_obstacle_without_an_index(tmp_path: Path) -> None:
    lone = write_scene(tmp_path / "lone", (START_NS, splats_of(BALLS[0])), unrepresented=[(0.5, 0.0, 0.0)])
    _, rows = query_points(lone, config=HARD)
    assert (rows[1]["splat"], rows[1]["label"]) == ("", "object")
    assert float(rows[1]["distance"]) == pytest.approx(0.2 - 0.05 * math.sqrt(3), abs=2e-3)


def test_a_grid_answers_within_its_box_and_leaves_the_rest_empty(scene: Path) -> None:
    field = baked(scene, scene.parent / "field", voxel=0.05, box=BOX).out
    result, rows = query_points(field)
    grid = GridField(read_npz(field / "field.npz"))
    assert column(rows, "distance")[:4, 0] == pytest.approx(grid.query(POINTS[:4])[0], abs=1e-6)
    assert column(rows, "bound")[:4, 0] == pytest.approx(grid.certified(POINTS[:4]), abs=1e-6)
    assert [row["in_box"] for row in rows] == ["1"] * 4 + ["0"]
    assert [rows[4][name] for name in TITLES[4:]] == [""] * 13
    assert rows[0]["observed"] == "free" and {row["splat"] + row["surface_x"] for row in rows} == {""}
    assert (result.metrics["num_outside"], result.metrics["num_answered"]) == (1, 4)
    assert "1 of 5 points lie outside the box" in result.notes[0]


def test_a_field_with_its_scene_has_the_distance_of_the_grid_and_the_rest_of_the_scene(
    scene: Path, tmp_path: Path
) -> None:
    """Another scene does not go with it."""
    field = baked(scene, scene.parent / "field", voxel=0.05, box=BOX).out
    _, of_grid = query_points(field)
    _, of_scene = query_points(scene)
    result, both = query_points(field / "field.npz", scene=scene)
    for name in ("in_box", "distance", "gradient_x", "bound"):
        assert [row[name] for row in both] == [row[name] for row in of_grid]
    for name in ("label", "splat", "observed", "surface_x", "surface_rest"):
        assert [row[name] for row in both] == [row[name] for row in of_scene]
    assert (both[4]["probability"], result.document["source"]) == ("", "field and scene")
    other = write_scene(tmp_path / "other", (START_NS, splats_of(BALLS[0])))
    expect_refusal(
        r"field: was not baked from the splats of .*other; .* as --scene",
        query_points,
        field,
        scene=other,
        error=UsageError,
    )


def test_blocks_change_no_answer(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    whole = query_points(scene, points)
    monkeypatch.setattr(ply, "POINTS_PER_BLOCK", 7)
    parts = query_points(scene, points)
    assert (parts[1], parts[0].metrics) == (whole[1], pytest.approx(whole[0].metrics))


def test_a_bare_splat_file_knows_nothing_of_space(tmp_path: Path) -> None:
    write_ply(tmp_path / "splats.ply", splats_of(*BALLS), {})
    result, rows = query_points(tmp_path / "splats.ply")
    assert {row["observed"] + row["in_box"] for row in rows} == {""}
    assert result.metrics["num_never_seen"] is None and result.notes == ()


def test_a_wrong_line_after_many_right_ones_leaves_no_file(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "POINTS_PER_BLOCK", 2)
    out = scene.parent / "none.csv"
    table = io.StringIO("1,2,3\n" * 5 + "1,2\n")
    expect_refusal(
        "standard input: line 6: expected 3 columns, got 2", query, QueryRequest(source=scene, points=table, out=out)
    )
    assert [path.name for path in scene.parent.iterdir()] == ["scene"]


def test_cells_without_a_distance_are_told(scene: Path) -> None:
    outside = (-2.5, -0.4, -0.4, 0.9, 0.4, 0.4)
    field = baked(scene, scene.parent / "field", voxel=0.1, box=outside, field={"unknown": "nan"}).out
    result, rows = query_points(field, np.array([[-2.2, 0.0, 0.0], [0.0, 0.0, 0.25]]))
    assert rows[0]["distance"] == "" and rows[1]["distance"] != ""
    assert any("1 points lie next to unseen cells" in note for note in result.notes)
