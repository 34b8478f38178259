import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.field_accuracy import field_accuracy, grid_distances, median_radius
from splatctrl_cli.records import DistanceGrid

TRUTH = np.array([0.01, 0.015, 0.03, 0.07, 0.15, 0.3, -0.01])


def test_errors_are_counted_in_the_band_of_the_true_distance() -> None:
    error = np.array([0.001, 0.003, -0.002, 0.0, 0.02, 1.0, 1.0])
    seen = np.array([True, False, True, True, True, True, True])
    report = field_accuracy({"hard": TRUTH + error, "gpdf": TRUTH}, TRUTH, seen, median_radius=0.005)
    near, middle, far, farther = report.everywhere["hard"]
    assert (near.count, middle.count, far.count, farther.count) == (2, 1, 1, 1)
    assert near.mean == pytest.approx(0.002)
    assert near.rmse == pytest.approx(np.sqrt((1 + 9) / 2) * 1e-3)
    assert near.median == pytest.approx(0.002)
    assert near.over_max == pytest.approx(0.003)
    assert middle.over_max == pytest.approx(-0.002)
    assert report.seen["hard"][0].count == 1
    assert report.seen["hard"][0].over_95 == pytest.approx(0.001)
    assert report.everywhere["gpdf"][3].rmse == 0.0


def test_over_estimate_counts_seen_cells_beyond_a_centimetre_and_the_median_radius() -> None:
    error = np.array([0.0149, 0.5, 0.0, 0.016, 0.019, 9.0, 9.0])
    seen = np.array([True, False, True, True, True, True, True])
    over = field_accuracy({"hard": TRUTH + error}, TRUTH, seen, median_radius=0.005).over_estimate
    assert (over.allowance, over.count, over.count_beyond) == (0.015, 4, 2)
    assert over.share_beyond == 0.5
    assert over.median_beyond == pytest.approx(0.0025)
    assert over.max_error == pytest.approx(0.019)
    assert not over.holds


def test_bands_without_cells_have_no_figures_and_nothing_holds() -> None:
    report = field_accuracy({"hard": np.ones(1)}, np.ones(1), np.array([True]), median_radius=0.0)
    assert report.everywhere["hard"][0].rmse is None
    assert report.as_dict()["holds"] is False


def test_arrays_that_do_not_fit_are_named() -> None:
    with pytest.raises(InputError, match=r"gpdf: expected \(7,\) values"):
        field_accuracy({"hard": TRUTH, "gpdf": TRUTH[:3]}, TRUTH, TRUTH > 0, median_radius=0.0)
    with pytest.raises(InputError, match="expected one named hard, got gpdf"):
        field_accuracy({"gpdf": TRUTH}, TRUTH, TRUTH > 0, median_radius=0.0)


def test_without_a_word_on_what_was_seen_every_point_counts() -> None:
    error = np.array([0.0149, 0.5, 0.0, 0.0, 0.0, 9.0, 9.0])
    report = field_accuracy({"hard": TRUTH + error}, TRUTH, None, median_radius=0.005)
    assert report.seen == {}
    assert (report.over_estimate.count, report.over_estimate.count_beyond) == (5, 1)


def test_hard_comes_back_from_the_bound_of_a_grid() -> None:
    sdf = np.zeros((2, 2, 2), np.float32)
    bound = np.full((2, 2, 2), 0.083, np.float32)
    header: dict[str, object] = {"bound_margin": 0.0175, "health": {"radius": 0.01}}
    grid = DistanceGrid(origin=np.zeros(3), voxel=0.02, channels={"sdf": sdf, "bound": bound}, header=header)
    np.testing.assert_allclose(grid_distances(grid)["hard"].at(np.array([0, 5])), [0.1005, 0.1005], atol=1e-7)
    assert median_radius(grid) == 0.01
    with_hard = DistanceGrid(
        origin=np.zeros(3), voxel=0.02, channels={"sdf": sdf, "hard": bound, "se": sdf}, header={}
    )
    np.testing.assert_array_equal(grid_distances(with_hard)["hard"].at(np.arange(8)), bound.ravel())
    assert list(grid_distances(with_hard)) == ["sdf", "hard", "se"]
    for header in ({}, {"bound_margin": "wide"}):
        bare = DistanceGrid(origin=np.zeros(3), voxel=0.02, channels={"sdf": sdf, "bound": bound}, header=header)
        with pytest.raises(InputError, match="expected a channel hard or bound, got sdf, bound"):
            grid_distances(bare)
