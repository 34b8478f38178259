"""Published splits: the numbers of their views, and scans that do not have them."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.protocols import cloud_of_scan, read_observed, score_protocol
from splatctrl_cli.records import Bool, Float64

DTU = range(49)


@pytest.mark.parametrize(("name", "num"), [("regnerf-3", 3), ("regnerf-6", 6), ("regnerf-9", 9)])
def test_regnerf_trains_on_its_first_views_and_scores_25(name: str, num: int) -> None:
    split = score_protocol(name).split(DTU, "scan")
    assert split.training == (25, 22, 28, 40, 44, 48, 0, 8, 13)[:num]
    assert split.scored == (1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35, 41, 42, 43, 45,
                            46, 47)  # fmt: skip
    assert {3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 36, 37, 38, 39} <= set(split.left_out)
    assert len(split.training) + len(split.scored) + len(split.left_out) == 49


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


def test_regnerf_leaves_out_what_a_scan_of_64_views_has_more() -> None:
    split = score_protocol("regnerf-3").split(range(64), "scan")
    assert set(range(49, 64)) <= set(split.left_out)


def test_mvsnerf_scores_four_views_where_there_is_depth() -> None:
    split = score_protocol("mvsnerf").split(DTU, "scan")
    assert split.scored == (32, 24, 23, 44)
    assert len(split.training) == 16
    assert not set(split.training) & set(split.scored)


def test_every_eighth_view_is_scored_and_all_of_dtu_train() -> None:
    assert score_protocol("dtu-holdout8").split(DTU, "scan").scored == (0, 8, 16, 24, 32, 40, 48)
    split = score_protocol("dtu-train").split(DTU, "scan")
    assert split.training == split.scored == tuple(DTU)


def test_published_means_are_over_so_many_scans() -> None:
    names = ("regnerf-3", "mvsnerf", "dtu-train", "dtu-holdout8")
    assert [len(score_protocol(name).scans) for name in names] == [15, 5, 15, 0]
    assert score_protocol("regnerf-9").scans == (8, 21, 30, 31, 34, 38, 40, 41, 45, 55, 63, 82, 103, 110, 114)
    assert score_protocol("dtu-train").scans[:6] == (24, 37, 40, 55, 63, 65)


def test_every_eighth_counts_the_views_that_are_there() -> None:
    assert score_protocol("dtu-holdout8").split([1, 3, *range(5, 15)], "scan").scored == (1, 11)


def test_a_rule_by_hand() -> None:
    assert score_protocol("holdout:every4+1").split(range(10), "scan").scored == (1, 5, 9)
    split = score_protocol("holdout:7,2").split(range(9), "scan")
    assert split.scored == (2, 7)
    assert split.words() == "train 0-1, 3-6, 8; score 2, 7"


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
    with pytest.raises(UsageError, match=message):
        score_protocol(name)


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
    with pytest.raises(InputError, match=message):
        score_protocol(name).split(range(num), "scan1")


LOW, HIGH = np.array([-30.0, -20.0, 500.0]), np.array([30.0, 20.0, 560.0])


def test_a_point_counts_where_its_nearest_cell_was_observed(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mask = rng.random((12, 8, 12)) < 0.5
    write_observed(tmp_path, 24, LOW, HIGH, mask)
    space = read_observed(tmp_path, "scan24")
    points = rng.uniform(LOW - 15, HIGH + 15, (4000, 3))  # [mm]
    expected, near = [], []
    for point in points:
        cell = [round(float(x)) for x in (point - LOW) / RESOLUTION]
        inside = all(0 <= c < n for c, n in zip(cell, mask.shape, strict=True))
        expected.append(bool(inside and mask[tuple(cell)]))
        near.append(bool(((point >= LOW - 60) & (point < HIGH + 120)).all()))
    assert 300 < sum(expected) < 3000
    assert space.observed(points / 1000).tolist() == expected
    assert space.near(points / 1000).tolist() == near
    assert space.near(np.array([[0.0, 0.0, 0.679], [0.0, 0.0, 0.681], [-0.091, 0.0, 0.5]])).tolist() == [
        True,
        False,
        False,
    ]


def test_a_point_of_the_reference_counts_above_the_ground(tmp_path: Path) -> None:
    write_observed(tmp_path, 7, LOW, HIGH)
    space = read_observed(tmp_path, "scan7")
    assert space.above(np.array([[0.0, 0.0, 0.5301], [5.0, 5.0, 0.5299]])).tolist() == [True, False]


def test_files_are_named_by_the_scan_and_damage_is_named(tmp_path: Path) -> None:
    write_observed(tmp_path, 24, LOW, HIGH)
    with pytest.raises(InputError, match=r"ObsMask25_10.mat: no such file; give the folder ObsMask"):
        read_observed(tmp_path, "scan25")
    with pytest.raises(InputError, match="scan 'bird': expected a name with DTU's number, such as scan24"):
        read_observed(tmp_path, "bird")
    (tmp_path / "Plane24.mat").write_bytes(b"no")
    with pytest.raises(InputError, match=r"Plane24.mat: not a MATLAB file that can be read"):
        read_observed(tmp_path, "scan24")
    (tmp_path / "ObsMask24_10.mat").write_bytes((tmp_path / "ObsMask24_10.mat").read_bytes()[:200])
    with pytest.raises(InputError, match=r"ObsMask24_10.mat: "):
        read_observed(tmp_path, "scan24")


def test_points_of_a_scan_are_found_by_either_name(tmp_path: Path) -> None:
    (tmp_path / "stl024_total.ply").touch()
    (tmp_path / "bird.ply").touch()
    assert cloud_of_scan(tmp_path, "scan24").name == "stl024_total.ply"
    assert cloud_of_scan(tmp_path, "bird").name == "bird.ply"
    with pytest.raises(InputError, match=r"the points of scan8, scan8.ply or stl008_total.ply, got neither"):
        cloud_of_scan(tmp_path, "scan8")


RESOLUTION = 5.0  # [mm]


def write_observed(folder: Path, number: int, low: Float64, high: Float64, is_observed: Bool | None = None) -> None:
    """The files of a scan: a box [mm], observed everywhere unless said otherwise, the ground half way up in z."""
    shape = tuple(int(n) for n in np.ceil((high - low) / RESOLUTION))
    mask = np.ones(shape, np.uint8) if is_observed is None else is_observed.astype(np.uint8)
    variables = {"ObsMask": mask, "BB": np.vstack([low, high]), "Res": RESOLUTION}
    savemat(folder / f"ObsMask{number}_10.mat", variables, do_compression=True)
    plane = np.array([[0.0], [0.0], [1.0], [-0.5 * (low[2] + high[2])]])
    savemat(folder / f"Plane{number}.mat", {"P": plane})
