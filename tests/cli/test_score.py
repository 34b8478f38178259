"""``splatctrl score``: of one scene, and of several scans."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.evaluate.score import other_scans
from splatctrl_cli.recording.folder.dtu import read_dtu
from splatctrl_cli.recording.folder.idr import write_idr
from splatctrl_cli.records import LossReport
from tests.jobs.score.wall import FRAMES, FakeScene, FakeSource, set_up, write_scene
from tests.recording.folder.make_layout import half_size


@pytest.fixture
def scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, and the recording FRAMES."""
    return write_scene(tmp_path, monkeypatch)


def run(folder: Path, *arguments: object) -> int:
    return main(["score", str(folder / "scene"), "--reference", "fake.mcap", *map(str, arguments)])


def test_the_table_shows_each_view_and_the_mean(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "score: PASSED (3 views)"
    table = [line.split("  ")[0] for line in lines[lines.index("") + 1 :]]
    assert (table[0], table[2:5], table[6]) == ("view", ["cam3-0001", "cam3-0002", "cam3-0003"], "mean of 3")
    assert "3 views scored, 1 before the first snapshot" in lines[-2] and lines[-1].startswith("in front: ")


def test_a_gate_that_fails_leaves_the_scores_and_exits_1(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored, "-o", scored / "score", "--require", "psnr_seen>=20", "--require", "psnr_all>=90") == 5
    assert "psnr_all is" in capsys.readouterr().out
    assert (scored / "score" / "score.json").is_file()


def test_damaged_input_exits_3(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES, loss=LossReport(damaged=1)))
    assert run(scored) == 3


def test_free_space_is_printed_and_gated(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (scored / "scene" / "occupancy.npz").touch()
    assert run(scored, "--require", "free_mass<=0.1") == 1
    out = capsys.readouterr().out
    assert "of the splats' mass is in space observed free" in out and "in front" in out


HOLDOUT = ("--protocol", "holdout:0")
COARSE = ("-q", "--max-splats", "300", "--set", "scene.first_iterations=4", "--set", "scene.refine_iterations=0")


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
            main(["reconstruct", "--dtu", str(folder / "idr"), "--scan", scan, *HOLDOUT, "-o", str(out), *COARSE])
            == 0
        )
    return folder


def run_scans(place: Path, *arguments: object) -> int:
    return main(["score", str(place / "scenes"), "--dtu", str(place / "idr"), *HOLDOUT, *map(str, arguments)])


def test_the_mean_is_over_the_scans_whose_own_means_stand_beside_it(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_scans(place, "--json", "-q", "-o", tmp_path / "out", "--require", "num_scans>=2") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["scans"] == ["scan21", "scan8"]
    each = [result["results"][scan]["metrics"] for scan in result["scans"]]
    assert each[0]["psnr_masked"] != each[1]["psnr_masked"] and result["metrics"]["num_views"] == 2
    for name in ("psnr_masked", "ssim_all", "depth_median_seen"):
        assert result["metrics"][name] == pytest.approx((each[0][name] + each[1][name]) / 2)
    assert result["protocol"]["averaging"] == "mean over the views of a scan, then over the scans"
    files = (tmp_path / "out" / "score.json", tmp_path / "out" / "scan8" / "score.json")
    assert [json.loads(file.read_text())["metrics"] for file in files] == [result["metrics"], each[1]]
    assert [line.split(",")[0] for line in (tmp_path / "out" / "scans.csv").read_text().splitlines()] == [
        "scan",
        "scan21",
        "scan8",
    ]


def test_the_table_has_a_row_for_each_scan(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_scans(place, "-q", "--scan", "scan8,scan21") == 0
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
    assert run_scans(place, "-q", "--scan", "scan8,scan9") == 4
    assert "no scene 'scan9'; scenes: scan21, scan8" in capsys.readouterr().err
    assert run_scans(place, "-q", "--scan", "scan8", "--require", "psnr_masked>=90") == 1
    printed, said = capsys.readouterr()
    assert "score: GATE FAILED (1 view of 1 scan): --require psnr_masked>=90: psnr_masked is " in printed
    assert "GATE FAILED" not in said, "once"


def test_scans_that_are_not_those_of_the_published_mean_are_named() -> None:
    protocol = {"name": "mvsnerf", "published_scans": [1, 8, 21, 103, 114]}
    (line,) = other_scans(protocol, ["scan8", "scan21", "bird"])
    assert line == ("mvsnerf: this mean lacks scans 1, 103, 114 and has bird more; the published one is of 5 scans")
    assert other_scans(protocol, [f"scan{n}" for n in (1, 8, 21, 103, 114)]) == []
    assert other_scans(protocol | {"published_scans": None}, ["scan8"]) == []
