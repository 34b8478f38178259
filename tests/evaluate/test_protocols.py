"""Published splits: the numbers of their views, and scans that do not have them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.protocols import cloud_of_scan, read_observed, score_protocol
from splatctrl_cli.records import Bool, Float64
from tests.refused import expect_refusal

DTU = range(49)


@pytest.mark.parametrize("num_views", [49, 64])
@pytest.mark.parametrize("num", [3, 6, 9])
def test_regnerf_trains_on_its_first_views_and_scores_25(num: int, num_views: int) -> None:
    """It leaves out what a scan of 64 views has more."""
    split = score_protocol(f"regnerf-{num}").split(range(num_views), "scan")
    assert split.training == (25, 22, 28, 40, 44, 48, 0, 8, 13)[:num]
    assert split.scored == (1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35, 41, 42, 43, 45,
                            46, 47)  # fmt: skip
    assert {3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 36, 37, 38, 39, *range(49, num_views)} <= set(split.left_out)
    assert len(split.training) + len(split.scored) + len(split.left_out) == num_views


@pytest.mark.parametrize(
    ("name", "mask", "fill", "size"),
    [
        *((f"regnerf-{num}", "object", 1.0, (400, 300)) for num in (3, 6, 9)),
        ("mvsnerf", "depth", 0.0, (640, 512)),
        ("dtu-train", "given", 0.0, None),
    ],
)
def test_published_figures_are_of_these_pixels(
    name: str, mask: str, fill: float, size: tuple[int, int] | None
) -> None:
    """Width and height; outside the mask SSIM sees white (regnerf/eval.py) or black."""
    protocol = score_protocol(name)
    assert (protocol.mask, protocol.fill, protocol.size) == (mask, fill, size)


@pytest.mark.parametrize(
    ("name", "views", "num_training", "scored"),
    [
        ("mvsnerf", DTU, 16, (32, 24, 23, 44)),  # where there is depth
        ("dtu-holdout8", DTU, 42, (0, 8, 16, 24, 32, 40, 48)),
        ("dtu-holdout8", [1, 3, *range(5, 15)], 10, (1, 11)),
        ("dtu-train", DTU, 49, tuple(DTU)),
        ("holdout:every4+1", range(10), 7, (1, 5, 9)),
        ("holdout:7,2", range(9), 7, (2, 7)),
    ],
)
def test_a_rule_scores_these_views(
    name: str, views: Sequence[int], num_training: int, scored: tuple[int, ...]
) -> None:
    split = score_protocol(name).split(views, "scan")
    assert (len(split.training), split.scored) == (num_training, scored)
    assert name == "dtu-train" or not set(split.training) & set(scored)
    assert name != "holdout:7,2" or split.words() == "train 0-1, 3-6, 8; score 2, 7"


def test_published_means_are_over_so_many_scans() -> None:
    names = ("regnerf-3", "mvsnerf", "dtu-train", "dtu-holdout8")
    assert [len(score_protocol(name).scans) for name in names] == [15, 5, 15, 0]
    assert score_protocol("regnerf-9").scans == (8, 21, 30, 31, 34, 38, 40, 41, 45, 55, 63, 82, 103, 110, 114)
    assert score_protocol("dtu-train").scans[:6] == (24, 37, 40, 55, 63, 65)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("regnerf3", r"unknown; did you mean regnerf-3\?"),
        ("x", "unknown; use one of: dtu-train, dtu-holdout8, regnerf-3"),
        ("holdout:", "expected holdout:everyN, holdout:everyN"),
        ("holdout:every1", "expected every N of at least 2 and FIRST below N, got 1 and 0"),
        ("holdout:every4+4", "got 4 and 4"),
    ],
)
def test_a_name_that_is_none_is_refused_with_the_choices(name: str, message: str) -> None:
    expect_refusal(message, score_protocol, name, error=UsageError)


@pytest.mark.parametrize(
    ("name", "num", "message"),
    [
        (
            "regnerf-3",
            8,
            "scan1: protocol regnerf-3: expected views .*got no view 9-12, 14-15.*the scan has views 0-7",
        ),
        ("holdout:2,9", 8, "got no view 9"),
        ("dtu-holdout8", 1, "expected views to train and views to score, got 0 and 1 of 1 views"),
        ("holdout:every8+7", 5, "got 5 and 0 of 5 views"),
    ],
)
def test_a_scan_without_the_views_is_refused(name: str, num: int, message: str) -> None:
    expect_refusal(message, score_protocol(name).split, range(num), "scan1")


LOW, HIGH = np.array([-30.0, -20.0, 500.0]), np.array([30.0, 20.0, 560.0])


def test_a_point_counts_where_its_nearest_cell_was_observed(tmp_path: Path) -> None:
    """A point of the reference counts above the ground."""
    rng = np.random.default_rng(0)
    mask = rng.random((12, 8, 12)) < 0.5
    write_observed(tmp_path, 24, LOW, HIGH, mask)
    space = read_observed(tmp_path, "scan24")
    points, expected = rng.uniform(LOW - 15, HIGH + 15, (4000, 3)), []  # [mm]
    for point in points:
        cell = tuple(round(float(x)) for x in (point - LOW) / RESOLUTION)
        expected.append(bool(all(0 <= c < n for c, n in zip(cell, mask.shape, strict=True)) and mask[cell]))
    assert 300 < sum(expected) < 3000 and space.observed(points / 1000).tolist() == expected
    assert space.near(points / 1000).tolist() == ((points >= LOW - 60) & (points < HIGH + 120)).all(axis=1).tolist()
    around = np.array([[0.0, 0.0, 0.679], [0.0, 0.0, 0.681], [-0.091, 0.0, 0.5]])
    assert space.near(around).tolist() == [True, False, False]
    assert space.above(np.array([[0.0, 0.0, 0.5301], [5.0, 5.0, 0.5299]])).tolist() == [True, False]


@pytest.mark.parametrize(
    ("scan", "damaged", "words"),
    [
        ("scan25", "", r"ObsMask25_10.mat: no such file; give the folder ObsMask"),
        ("bird", "", "scan 'bird': expected a name with DTU's number, such as scan24"),
        ("scan24", "Plane24.mat", r"Plane24.mat: not a MATLAB file that can be read"),
        ("scan24", "ObsMask24_10.mat", r"ObsMask24_10.mat: "),
    ],
)
def test_files_are_named_by_the_scan_and_damage_is_named(tmp_path: Path, scan: str, damaged: str, words: str) -> None:
    write_observed(tmp_path, 24, LOW, HIGH)
    if damaged:
        (tmp_path / damaged).write_bytes((tmp_path / damaged).read_bytes()[: 200 if "Obs" in damaged else 2])
    expect_refusal(words, read_observed, tmp_path, scan)


def test_points_of_a_scan_are_found_by_either_name(tmp_path: Path) -> None:
    for scan, name in (("scan24", "stl024_total.ply"), ("bird", "bird.ply")):
        (tmp_path / name).touch()
        assert cloud_of_scan(tmp_path, scan).name == name
    expect_refusal(
        r"the points of scan8, scan8.ply or stl008_total.ply, got neither", cloud_of_scan, tmp_path, "scan8"
    )


RESOLUTION = 5.0  # [mm]


def write_observed(folder: Path, number: int, low: Float64, high: Float64, is_observed: Bool | None = None) -> None:
    """The files of a scan: a box [mm], observed everywhere unless said otherwise, the ground half way up in z."""
    shape = tuple(int(n) for n in np.ceil((high - low) / RESOLUTION))
    mask = np.ones(shape, np.uint8) if is_observed is None else is_observed.astype(np.uint8)
    savemat(
        folder / f"ObsMask{number}_10.mat",
        {"ObsMask": mask, "BB": np.vstack([low, high]), "Res": RESOLUTION},
        do_compression=True,
    )
    savemat(folder / f"Plane{number}.mat", {"P": np.array([[0.0], [0.0], [1.0], [-0.5 * (low[2] + high[2])]])})
