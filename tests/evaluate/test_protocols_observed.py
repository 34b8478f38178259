"""Masks and planes of DTU's own evaluation, as MATLAB writes them."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.protocols import cloud_of_scan, read_observed
from tests.evaluate.make_observed_space import RESOLUTION, write_observed

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
