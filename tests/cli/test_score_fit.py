"""``score --fit``: both methods on scans, in the form of the paper's table."""

import json
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main

QUICK = ("--fit", "--fit-iterations", "6", "--fit-splats", "400", "--threads", "1")


def test_both_methods_are_fitted_scored_and_printed_beside_the_paper(
    sample_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "fit"
    arguments = ["score", "--dtu", str(sample_data / "dtu"), *QUICK, "--protocol", "holdout:0,4", "-o", str(out)]
    assert main([*arguments, "--require", "psnr_ours>=5", "--require", "memory_3dgs<=4000"]) == 0
    done = capsys.readouterr()
    header, _, theirs, ours, *rest = done.out.splitlines()
    assert header.split("  ")[0] == "method"
    assert theirs.split()[:3] == ["3D-GS", "23.27", "50,000-100,000"]
    assert ours.split()[:3] == ["ours", "23.33", "10,000"]
    assert "split: train 1-3, 5-7; score 0, 4" in rest
    assert any(line.startswith("PSNR over every pixel; 400 splats to begin with, 6 iterations") for line in rest)
    result = json.loads((out / "score.json").read_text())
    assert [(fit["scan"], fit["method"], fit["iterations"]) for fit in result["fits"]] == [
        ("scan1", "3dgs", 6),
        ("scan1", "budget", 6),
    ]
    metrics = result["metrics"]
    assert metrics["psnr_gain"] == pytest.approx(metrics["psnr_ours"] - metrics["psnr_3dgs"])
    assert metrics["splats_ours"] <= 400
    for method in ("3dgs", "budget"):
        assert (out / "scan1" / method / "scene" / "splats.ply").is_file()
        assert (out / "scan1" / method / "score" / "score.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["scene"], 2, "--fit: makes the scenes itself, got scene"),
        (["--holdout", "2"], 2, "--fit: goes by a protocol; give --protocol holdout:2"),
        (["--fit-splats", "0"], 2, "--fit-splats: expected at least 1, got 0"),
        (["--scan", "scan1,scan9"], 4, "no scan 'scan9'; scans: scan1"),
        (["--require", "psnr_all>=1"], 2, "unknown metric"),
        (["--cloud", "x.ply"], 2, "--fit: compares with no cloud"),
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
    assert "expected scans (--dtu) or the TOML of an image folder" in capsys.readouterr().err


def test_what_reconstruct_refuses_is_passed_on(
    sample_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["score", "--dtu", str(sample_data / "dtu"), *QUICK, "--protocol", "regnerf-3"]) == 4
    said = capsys.readouterr().err
    assert "scan1: reconstruct ended with 4: " in said
    assert "no view 9-12" in said
