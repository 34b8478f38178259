"""``splatctrl score``: of one scene, of several scans, and of scans that it fits first (--fit)."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.datasets.dtu import read_dtu
from splatctrl_cli.datasets.idr import write_idr
from splatctrl_cli.evaluate.score_report import other_scans
from splatctrl_cli.evaluate.verdict import noted, verdict_of
from splatctrl_cli.jobs.reconstructions.reconstruct import ReconstructResult
from splatctrl_cli.jobs.scores import fit as score_fit
from splatctrl_cli.jobs.scores.score import ScoreRequest, ScoreResult
from splatctrl_cli.records import LossReport
from tests.cli import here
from tests.datasets.make_layout import half_size
from tests.jobs.scores.wall import FRAMES, FakeScene, FakeSource, set_up, write_scene


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
    table = lines[lines.index("") + 1 :]
    assert table[0].split("  ")[0] == "view"
    assert [line.split()[0] for line in table[2:5]] == ["cam3-0001", "cam3-0002", "cam3-0003"]
    assert table[6].startswith("mean of 3")
    assert "3 views scored, 1 before the first snapshot" in lines[-2]
    assert lines[-1].startswith("in front: ")


def test_a_gate_that_fails_leaves_the_scores_and_exits_1(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored, "-o", scored / "score", "--require", "psnr_seen>=20", "--require", "psnr_all>=90") == 5
    assert "psnr_all is" in capsys.readouterr().out
    assert (scored / "score" / "score.json").is_file()


def test_a_gate_on_an_unknown_metric_is_refused_before_anything_is_rendered(
    scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeScene, "splats_at", lambda scene, stamp_ns: pytest.fail("rendered"))
    assert run(scored, "--require", "num_skipped<=1", "--require", "sharpness>=1") == 2


def test_damaged_input_exits_3(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES, loss=LossReport(damaged=1)))
    assert run(scored) == 3


def test_a_single_view_is_counted_as_one(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES[2:4]))
    assert run(scored) == 0
    assert "\n1 view scored, 0 before" in capsys.readouterr().out


def test_free_space_is_printed_and_gated(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (scored / "scene" / "occupancy.npz").touch()
    assert run(scored, "--require", "free_mass<=0.1") == 1
    out = capsys.readouterr().out
    assert "of the splats' mass is in space observed free" in out
    assert "in front" in out


def test_a_scene_that_cannot_be_compared_prints_one_line(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES[:2]))
    assert run(scored, "--json") == 5
    done = capsys.readouterr()
    assert "no view of cam3 to score" in here.checked(done.out, 5)["error"]["message"]
    assert len([line for line in done.err.splitlines() if line.startswith("splatctrl: ")]) == 1


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


QUICK = ("--fit", "--fit-iterations", "6", "--fit-splats", "400", "--threads", "1")


def test_both_methods_are_fitted_scored_and_printed_beside_the_paper(
    sample_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_idr(tmp_path / "dtu", "scan1", [half_size(view) for view in read_dtu(sample_data / "dtu").views])
    out = tmp_path / "fit"
    arguments = ["score", "--dtu", str(tmp_path / "dtu"), *QUICK, "--protocol", "holdout:0", "-o", str(out)]
    assert main([*arguments, "--require", "psnr_ours>=5", "--require", "memory_3dgs<=4000"]) == 0
    verdict, table = capsys.readouterr().out.split("\n\n", 1)
    assert verdict.startswith("score: PASSED (2 fits of scan1)")
    header, _, theirs, ours, gain, *rest = table.splitlines()
    assert header.split("  ")[0] == "method"
    assert theirs.split()[:3] == ["3D-GS", "23.27", "50,000-100,000"]
    assert ours.split()[:3] == ["ours", "23.33", "10,000"]
    assert gain.split()[:5] == ["ours", "-", "3D-GS", "+0.06", "-"]
    assert rest[0].startswith("paper's: its section IV-A, on scans, views, sizes and iterations that")
    assert "split: train 1-7; score 0" in rest
    assert any(line.startswith("PSNR over the mask; 400 splats to begin with, 6 iterations") for line in rest)
    result = json.loads((out / "score.json").read_text())
    fits = {fit["method"]: fit for fit in result["fits"]}
    assert list(fits) == ["3dgs", "budget"]
    assert {fit["iterations"] for fit in fits.values()} == {6}
    assert fits["3dgs"]["psnr"] == fits["3dgs"]["metrics"]["psnr_masked"]
    assert result["metrics"]["splats_ours"] <= 400
    for method in fits:
        assert (out / "scan1" / method / "scene" / "splats.ply").is_file()
        assert (out / "scan1" / method / "score" / "score.json").is_file()
    assert (out / "scan1" / "methods.png").is_file()


def test_the_mean_is_over_the_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for scan in ("scan1", "scan2"):
        (tmp_path / "Rectified" / f"{scan}_train").mkdir(parents=True)
    psnr = {("scan1", "3dgs"): 20.0, ("scan1", "budget"): 21.0, ("scan2", "3dgs"): 30.0, ("scan2", "budget"): 32.5}

    def reconstruct(request: Any, scoring: ScoreRequest, method: str, out: Path, *_: Any) -> Any:
        metrics = {"splats": 100, "iterations": 5}
        verdict = verdict_of("reconstruct", [])
        scene = ReconstructResult(out=out, metrics=metrics, verdict=verdict, removed={}, seconds={"fit": 3.0})
        return scene, 50.0 if scoring.recording.scan == "scan1" else 70.0

    def score(request: ScoreRequest, folder: Path | None, progress: Any) -> ScoreResult:
        metrics = dict.fromkeys(("psnr_seen", "ssim_all", "num_views"), 1.0) | {
            "psnr_all": psnr.get((request.recording.scan, request.scene.parent.name))
        }
        protocol = {"name": "x", "source": "y", "split": "z", "mask_rule": "none", "background": [0.0],
                    "published_resolution": None, "published_scans": None, "resolution": ["1x1"]}  # fmt: skip
        report = {"metrics": metrics, "protocol": protocol, "warnings": ["odd"]}
        return ScoreResult(report=report, verdict=verdict_of("score", []))

    monkeypatch.setattr(score_fit, "_reconstruct", reconstruct)
    monkeypatch.setattr(score_fit, "score_scene", score)
    assert main(["score", "--fit", "--dtu", str(tmp_path), "-q", "--json", "--require", "psnr_gain>=1.7"]) == 0
    result = json.loads(capsys.readouterr().out)
    metrics = result["metrics"]
    assert (metrics["psnr_3dgs"], metrics["psnr_ours"], metrics["psnr_gain"]) == (25.0, 26.75, 1.75)
    assert metrics["memory_ours"] == 70.0
    assert (metrics["ssim_all_ours"], metrics["num_scans"], metrics["num_warnings"]) == (1.0, 2, 4)
    assert result["warnings"][1] == "scan1, ours: odd"
    assert result["protocol"]["averaging"] == "mean over the views of a scan, then over the scans"
    assert main(["score", "--fit", "--dtu", str(tmp_path), "-q", "--require", "psnr_gain>=2"]) == 1
    assert "scan1 dB  scan2 dB  mean dB" in capsys.readouterr().out
    del psnr["scan2", "budget"]
    assert main(["score", "--fit", "--dtu", str(tmp_path), "-q", "--require", "psnr_ours>=2"]) == 5
    assert "psnr_ours is unknown" in capsys.readouterr().out, "a scan without a figure leaves no mean"


def test_what_reconstruct_refuses_is_passed_on(
    sample_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["score", "--dtu", str(sample_data / "dtu"), *QUICK, "--protocol", "regnerf-3"]) == 4
    said = capsys.readouterr().err
    assert "scan1: reconstruct ended with 4: " in said
    assert "no view 9-12" in said


def test_an_interrupted_fit_does_not_promise_to_go_on(
    sample_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(request: Any, progress: Any) -> Any:
        raise KeyboardInterrupt("go on with the same command and --resume")

    monkeypatch.setattr(score_fit, "reconstruct_gaussians", interrupted)
    assert main(["score", "--dtu", str(sample_data / "dtu"), *QUICK, "--protocol", "holdout:0", "-q"]) == 130
    assert capsys.readouterr().err == "splatctrl: interrupted\n"


def test_a_fit_whose_verdict_does_not_pass_is_not_scored(
    sample_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def damaged(request: Any, progress: Any) -> ReconstructResult:
        verdict = verdict_of("reconstruct", [noted("x", "y")], scope="7 views", is_damaged=True)
        return ReconstructResult(out=request.out, metrics={}, verdict=verdict, removed={}, seconds={})

    monkeypatch.setattr(score_fit, "reconstruct_gaussians", damaged)
    assert main(["score", "--dtu", str(sample_data / "dtu"), *QUICK, "--protocol", "holdout:0", "-q"]) == 4
    why = "PASSED, part of the recording is damaged and left out (7 views)"
    assert f"scan1: reconstruct ended with 3: reconstruct: {why}" in capsys.readouterr().err
