"""``score --fit``: both methods on scans, in the form of the paper's table."""

import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.datasets.dtu import read_dtu
from splatctrl_cli.datasets.idr import write_idr
from splatctrl_cli.evaluate.verdict import noted, verdict_of
from splatctrl_cli.jobs import score_fit
from splatctrl_cli.jobs.reconstruct import ReconstructResult
from splatctrl_cli.jobs.score import ScoreRequest, ScoreResult
from tests.datasets.make_idr import half_size

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
    picture = cv2.imread(str(out / "scan1" / "methods.png"))
    assert picture is not None
    assert picture.shape[1] == 1200


def test_the_mean_is_over_the_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for scan in ("scan1", "scan2"):
        (tmp_path / "Rectified" / f"{scan}_train").mkdir(parents=True)
    psnr = {("scan1", "3dgs"): 20.0, ("scan1", "budget"): 21.0, ("scan2", "3dgs"): 30.0, ("scan2", "budget"): 32.5}

    def reconstruct(request: Any, scoring: ScoreRequest, method: str, out: Path) -> Any:
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
    assert "psnr_ours is unknown" in capsys.readouterr().err, "a scan without a figure leaves no mean"


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["scene"], 2, "--fit: makes the scenes itself, got scene"),
        (["--holdout", "2"], 2, "--fit: goes by a protocol; give --protocol holdout:2"),
        (["--fit-splats", "0"], 2, "--fit-splats: expected a whole number, 1 to 10000000"),
        (["--scan", "scan1,scan9"], 4, "no scan 'scan9'; scans: scan1"),
        (["--require", "psnr_best>=1"], 2, "unknown metric"),
        (["--cloud", "."], 4, "expected the points of scan1, scan1.ply or stl001_total.ply, got neither"),
        (["--lpips", "x.npz"], 4, "x.npz: cannot be read: No such file"),
        (["--set", "scene.nothing=1"], 2, "scene.nothing"),
    ],
)
def test_bad_usage_is_refused_before_anything_is_fitted(
    sample_data: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, message: str
) -> None:
    assert main(["score", "--dtu", str(sample_data / "dtu"), *QUICK, *arguments]) == code
    assert message in capsys.readouterr().err


def test_a_log_has_no_baseline(sample_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", "--reference", str(sample_data / "tabletop" / "log.mcap"), *QUICK]) == 2
    assert "expected scans (--dtu) or an image folder, got " in capsys.readouterr().err


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
    def interrupted(request: Any) -> Any:
        raise KeyboardInterrupt("go on with the same command and --resume")

    monkeypatch.setattr(score_fit, "reconstruct_gaussians", interrupted)
    assert main(["score", "--dtu", str(sample_data / "dtu"), *QUICK, "--protocol", "holdout:0", "-q"]) == 130
    assert capsys.readouterr().err == "splatctrl: interrupted\n"


def test_a_fit_whose_verdict_does_not_pass_is_not_scored(
    sample_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def damaged(request: Any) -> ReconstructResult:
        verdict = verdict_of("reconstruct", [noted("x", "y")], scope="7 views", is_damaged=True)
        return ReconstructResult(out=request.out, metrics={}, verdict=verdict, removed={}, seconds={})

    monkeypatch.setattr(score_fit, "reconstruct_gaussians", damaged)
    assert main(["score", "--dtu", str(sample_data / "dtu"), *QUICK, "--protocol", "holdout:0", "-q"]) == 4
    assert "scan1: reconstruct ended with 3: reconstruct: PASSED (7 views)" in capsys.readouterr().err
