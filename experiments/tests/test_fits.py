"""Both methods fitted to a scan, scored, printed beside the paper's figures and written."""

import json
from pathlib import Path

import pytest

from experiments import fits
from experiments.__main__ import main
from splatctrl_cli import (
    InputError,
    JudgedResult,
    ReconstructRequest,
    RecordingRequest,
    ScoreRequest,
)
from splatctrl_cli.config import Config
from splatctrl_cli.evaluate.verdict import note, verdict_of
from splatctrl_cli.recording.folder.dtu import read_dtu
from splatctrl_cli.recording.folder.idr import write_idr
from tests.recording.folder.make_layout import half_size

SAMPLE = Path(__file__).parents[2] / "sample_data" / "dtu"
QUICK = ("--iterations", "6", "--splats", "400", "--threads", "1")


def test_both_methods_are_fitted_scored_and_printed_beside_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_idr(tmp_path / "dtu", "scan1", [half_size(view) for view in read_dtu(SAMPLE).views])
    out = tmp_path / "fit"
    assert main(["fits", str(tmp_path / "dtu"), *QUICK, "--protocol", "holdout:0", "-o", str(out)]) == 0
    header, theirs, ours, gain, about, *rest = capsys.readouterr().out.splitlines()
    assert header.split("  ")[0] == "method"
    assert theirs.split()[:3] == ["3D-GS", "23.27", "50,000-100,000"]
    assert ours.split()[:3] == ["ours", "23.33", "10,000"]
    assert gain.split()[:5] == ["ours", "-", "3D-GS", "+0.06", "-"]
    assert about.startswith("paper's: its section IV-A, on scans, views, sizes and iterations that")
    assert any("split: train 1-7; score 0" in line for line in rest)
    assert any(line.startswith("PSNR over the mask; 400 splats to begin with, 6 iterations") for line in rest)
    result = json.loads((out / "fits.json").read_text())
    made = {fit["method"]: fit for fit in result["fits"]}
    assert list(made) == ["3dgs", "budget"] and made["3dgs"]["psnr"] == made["3dgs"]["metrics"]["psnr_masked"]
    assert result["metrics"]["psnr_ours"] > 5 and result["metrics"]["splats_ours"] <= 400
    for method in made:
        run = json.loads((out / "scan1" / method / "scene" / "run.json").read_text())
        assert (out / "scan1" / method / "score" / "score.json").is_file()
        assert run["config"]["scene"]["first_iterations"] == 6
        assert run["config"]["scene"]["max_splats"] == 400
    assert run["seed"] == 0


def test_the_mean_is_over_the_scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for scan in ("scan1", "scan2"):
        (tmp_path / "Rectified" / f"{scan}_train").mkdir(parents=True)
    psnr = {("scan1", "3dgs"): 20.0, ("scan1", "budget"): 21.0, ("scan2", "3dgs"): 30.0, ("scan2", "budget"): 32.5}

    def fit(
        request: fits.FitRequest, recording: RecordingRequest, method: str, out: Path
    ) -> tuple[JudgedResult, float | None]:
        verdict = verdict_of("reconstruct", [])
        scene = JudgedResult(out=out, metrics={"splats": 100}, verdict=verdict, seconds={"fit": 3.0})
        return scene, 50.0 if recording.scan == "scan1" else 70.0

    def score(request: ScoreRequest) -> JudgedResult:
        metrics = {"psnr_seen": 1.0, "psnr_all": psnr.get((request.recording.scan or "", request.scene.parent.name))}
        protocol = {"name": "x", "source": "y", "split": "z", "mask_rule": "none", "resolution": ["1x1"]}
        report = {"metrics": metrics, "protocol": protocol, "warnings": ["odd"]}
        return JudgedResult(document=report, metrics=metrics, notes=("odd",), verdict=verdict_of("score", []))

    monkeypatch.setattr(fits, "_fit", fit)
    monkeypatch.setattr(fits, "score", score)
    request = fits.FitRequest(
        recording=RecordingRequest(path=tmp_path, is_dtu=True), config=Config(), iterations=5, out=tmp_path / "out"
    )
    report = fits.fit_scans(request)
    metrics = report["metrics"]
    assert (metrics["psnr_3dgs"], metrics["psnr_ours"], metrics["psnr_gain"]) == (25.0, 26.75, 1.75)
    assert (metrics["memory_ours"], metrics["psnr_seen_ours"]) == (70.0, 1.0)
    assert report["warnings"][1] == "scan1, ours: odd"
    table = list(fits.lines_of(report))
    assert "scan1 dB  scan2 dB  mean dB" in table[0] and table[3].split()[5:8] == ["+1.00", "+2.50", "+1.75"]
    del psnr["scan2", "budget"]
    lacking = fits.fit_scans(fits.FitRequest(recording=request.recording, config=Config(), iterations=5))
    assert lacking["metrics"]["psnr_ours"] is None, "a scan without a figure leaves no mean"
    assert fits.known_scans(tmp_path) == ["scan1", "scan2"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--protocol", "regnerf-3"), "scan1, 3D-GS: "),
        (("--scan", "scan1,scan7"), "no scan 'scan7'; scans: scan1"),
    ],
)
def test_what_cannot_be_fitted_is_refused_by_name(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fits", str(SAMPLE), *QUICK, *words]) == 4
    assert said in capsys.readouterr().err


def test_a_fit_whose_verdict_does_not_pass_is_not_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(request: ReconstructRequest, settings: object) -> JudgedResult:
        verdict = verdict_of("reconstruct", [note(criterion="x", sentence="y")], scope="7 views", is_damaged=True)
        return JudgedResult(out=request.out, metrics={}, verdict=verdict, seconds={})

    monkeypatch.setattr(fits, "reconstruct_gaussians", damaged)
    recording = RecordingRequest(path=SAMPLE, is_dtu=True, protocol="holdout:0")
    with pytest.raises(InputError, match="scan1, 3D-GS: reconstruct: PASSED, part of the recording is damaged"):
        fits.fit_scans(fits.FitRequest(recording=recording, config=Config(), iterations=5))
