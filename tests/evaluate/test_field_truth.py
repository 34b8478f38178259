"""Cells before a wall at 2 m whose true distance is known: what the comparison counts, and what it says of them."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.field_truth import TrueCells, TruthComparison, compare_with_truth
from splatctrl_cli.records import Box, Float64
from tests.evaluate.test_visibility import wall_frame

HIDDEN, SEEN = -0.3, 0.3  # x of cells: a plate at 1 m hides the wall's left half


def cells(error: float = 0.004) -> TrueCells:
    """At each x, cells at 1, 3, 7 and 15 cm before the wall, behind it, and far away; sdf reads `error` too much."""
    distance = np.tile([0.01, 0.03, 0.07, 0.15, -0.01, 0.5], 2)
    x = np.repeat([HIDDEN, SEEN], 6)
    points = np.stack([x, np.zeros(12), 2.0 - distance], axis=1)
    return TrueCells(
        points=points,
        fields={"sdf": distance + error, "hard": distance.copy()},
        distance=distance,
        surface=np.stack([x, np.zeros(12), np.full(12, 2.0)], axis=1),
    )


def compared(given: TrueCells, workspace: Box | None = None) -> TruthComparison:
    def by_sign(points: Float64, sdf: Float64) -> Float64:
        return (sdf < 0).astype(np.float64)

    return compare_with_truth(
        given,
        [wall_frame()],
        name="truth.json",
        workspace=workspace,
        median_radius=0.01,
        probabilities={"by sign": by_sign},
    )


def test_cells_count_where_a_camera_saw_their_surface() -> None:
    found = compared(cells())
    assert (found.num_drawn, found.num_blank, found.num_near, found.num_seen) == (12, 0, 8, 4)
    assert [band.count for band in found.accuracy.seen["sdf"]] == [1, 1, 1, 1]
    assert [band.count for band in found.accuracy.everywhere["sdf"]] == [2, 2, 2, 2]
    assert all(band.mean == pytest.approx(0.004) for band in found.accuracy.seen["sdf"])
    assert found.error_mean == pytest.approx(0.004) and found.error_sigma == pytest.approx(0.0, abs=1e-12)
    curve = found.reliability["by sign"]
    assert (curve.count.sum(), curve.calibration_error) == (5, 0.0), "a cell behind the surface counts here"


def test_surfaces_outside_the_workspace_do_not_count() -> None:
    found = compared(cells(), Box(lower=np.array([-1.0, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.9])))
    assert (found.num_seen, found.num_outside_workspace, found.reliability) == (0, 4, {})
    assert found.error_mean is None and found.error_sigma is None


def test_cells_without_a_distance_are_blank_and_a_field_of_them_cannot_be_compared() -> None:
    given = cells()
    sdf = given.fields["sdf"].copy()
    sdf[6] = np.nan
    blank = compared(replace(given, fields={**given.fields, "sdf": sdf}))
    assert (blank.num_blank, blank.num_near, blank.num_seen) == (1, 7, 3)
    with pytest.raises(NotEvaluableError, match=r"truth\.json: no cell of the grid lies within 0\.2 m"):
        compared(replace(given, fields={**given.fields, "sdf": np.full(12, np.nan)}))
