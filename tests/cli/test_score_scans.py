"""``score`` of several scans: each against its scene, and the mean over the scans."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.datasets.dtu import read_dtu
from splatctrl_cli.datasets.idr import write_idr
from splatctrl_cli.evaluate.score_report import other_scans
from tests.datasets.make_idr import half_size

HOLDOUT = ("--protocol", "holdout:0")
QUICK = ("-q", "--max-splats", "300", "--set", "scene.first_iterations=4", "--set", "scene.refine_iterations=0")


@pytest.fixture(scope="module")
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans, made smaller, the second with its colours inverted, and their scenes."""
    sample_data: Path = request.getfixturevalue("sample_data")
    folder = tmp_path_factory.mktemp("scans")
    views = [half_size(view) for view in read_dtu(sample_data / "dtu").views[:3]]
    others = [replace(view, color=255 - view.color) for view in views[::-1]]
    for scan, some in (("scan8", views), ("scan21", others)):
        write_idr(folder / "idr", scan, some)
        out = folder / "scenes" / scan
        assert (
            main(["reconstruct", "--dtu", str(folder / "idr"), "--scan", scan, *HOLDOUT, "-o", str(out), *QUICK]) == 0
        )
    return folder


def run(place: Path, *arguments: object) -> int:
    return main(["score", str(place / "scenes"), "--dtu", str(place / "idr"), *HOLDOUT, *map(str, arguments)])


def test_the_mean_is_over_the_scans_whose_own_means_stand_beside_it(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(place, "--json", "-q", "-o", tmp_path / "out", "--require", "num_scans>=2") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["scans"] == ["scan21", "scan8"]
    each = [result["results"][scan]["metrics"] for scan in result["scans"]]
    assert each[0]["psnr_masked"] != each[1]["psnr_masked"]
    for name in ("psnr_masked", "ssim_all", "depth_median_seen"):
        assert result["metrics"][name] == pytest.approx((each[0][name] + each[1][name]) / 2)
    assert result["metrics"]["num_views"] == 2
    assert result["protocol"]["averaging"] == "mean over the views of a scan, then over the scans"
    assert json.loads((tmp_path / "out" / "score.json").read_text())["metrics"] == result["metrics"]
    assert json.loads((tmp_path / "out" / "scan8" / "score.json").read_text())["metrics"] == each[1]
    assert [line.split(",")[0] for line in (tmp_path / "out" / "scans.csv").read_text().splitlines()] == [
        "scan",
        "scan21",
        "scan8",
    ]


def test_the_table_has_a_row_for_each_scan(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(place, "-q", "--scan", "scan8,scan21") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("score: PASSED (2 views of 2 scans)\n")
    lines = printed.split("\n\n", 1)[1].splitlines()
    assert [line.split()[0] for line in lines[:6]] == [
        "scan",
        lines[1].split()[0],
        "scan8",
        "scan21",
        lines[1].split()[0],
        "mean",
    ]
    assert any(
        line.startswith("mask rule: object mask; averaging: mean over the views of a scan, then") for line in lines
    )


def test_a_scan_without_a_scene_and_a_gate_that_fails_are_named(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(place, "-q", "--scan", "scan8,scan9") == 4
    assert "no scene 'scan9'; scenes: scan21, scan8" in capsys.readouterr().err
    assert run(place, "-q", "--scan", "scan8", "--require", "psnr_masked>=90") == 1
    assert (
        "score: GATE FAILED (1 view of 1 scan): --require psnr_masked>=90: psnr_masked is " in capsys.readouterr().err
    )


def test_a_scene_of_another_scan_is_refused(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(place / "scenes" / "scan8", tmp_path / "scan21")
    assert main(["score", str(tmp_path), "--dtu", str(place / "idr"), *HOLDOUT, "-q"]) == 4
    assert "not the recording that" in capsys.readouterr().err


def test_scans_that_are_not_those_of_the_published_mean_are_named() -> None:
    protocol = {"name": "mvsnerf", "published_scans": [1, 8, 21, 103, 114]}
    (line,) = other_scans(protocol, ["scan8", "scan21", "bird"])
    assert line == ("mvsnerf: this mean lacks scans 1, 103, 114 and has bird more; the published one is of 5 scans")
    assert other_scans(protocol, [f"scan{n}" for n in (1, 8, 21, 103, 114)]) == []
    assert other_scans(protocol | {"published_scans": None}, ["scan8"]) == []
