"""`score` on scenes and recordings whose scores are known."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest
from splatctrl_cli.jobs.score.score import ScoreRequest, ScoreResult, score
from splatctrl_cli.recording.folder.dtu import DtuView, write_dtu
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Label, RgbdFrame
from tests.jobs.score.wall import (
    AWAY,
    FRAMES,
    FRONT,
    SECOND,
    SIDE,
    FakeScene,
    FakeSource,
    frame,
    set_up,
    wall,
    write_scene,
)


@pytest.fixture
def scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, and the recording FRAMES."""
    return write_scene(tmp_path, monkeypatch)


def run(folder: Path, cameras: tuple[str, ...] | None = None, **changes: Any) -> ScoreResult:
    recording = RecordingRequest(path=Path("fake.mcap"), options=SourceOptions(cameras=cameras))
    return score(ScoreRequest(scene=folder / "scene", recording=recording, **changes))


def test_views_are_rendered_from_the_newest_snapshot_and_early_ones_are_counted(scored: Path) -> None:
    result = run(scored)
    assert result.report["cameras"] == ["cam3"]
    assert result.report["skipped_views"] == ["cam3-0000"]
    dark, right, away = result.report["views"]
    assert (dark["view"], right["view"], away["view"]) == ("cam3-0001", "cam3-0002", "cam3-0003")
    assert dark["psnr_all"] == pytest.approx(20.0, abs=0.6), "0.4 instead of 0.5"
    assert right["psnr_all"] == pytest.approx(40.0, abs=2.5), "off by 0.01, and rounded to 8 bits"
    assert right["depth_median_all"] < 1e-6
    assert (result.metrics["num_views"], result.metrics["num_skipped"]) == (3, 1)
    assert (result.counts["psnr_all"], result.counts["psnr_seen"], result.notes) == (2, 2, ())


def test_seen_pixels_are_those_of_the_surface_that_the_training_camera_measured(scored: Path) -> None:
    _, side, away = run(scored).report["views"]
    assert side["seen_share"] == pytest.approx(58 / 64, abs=0.03), "the view is moved by 0.1 m, 6 pixels"
    assert away["seen_share"] == 0.0
    assert away["psnr_seen"] is None
    assert away["depth_median_all"] is None


def test_final_splats_serve_all_views_when_asked(scored: Path) -> None:
    first, *_ = run(scored, newest=False).report["views"]
    assert first["psnr_all"] > 50


def test_without_a_clock_every_view_is_scored_from_the_final_splats(
    scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(monkeypatch, FakeScene(has_clock=False, snapshots=()), FakeSource(frames=FRAMES, has_clock=False))
    report = run(scored).report
    assert report["snapshots"] == "final"
    assert report["metrics"]["num_skipped"] == 0
    assert len(report["views"]) == 4


@pytest.mark.parametrize("label", [None, Label.ROBOT])
def test_a_scene_without_a_splat_that_counts_is_not_evaluable_and_leaves_nothing(
    scored: Path, monkeypatch: pytest.MonkeyPatch, label: Label | None
) -> None:
    splats = wall()
    if label is None:
        splats = splats.select(np.zeros(len(splats), bool))
    else:
        splats.labels[:] = label
    monkeypatch.setattr(FakeScene, "splats", lambda scene: splats)
    with pytest.raises(NotEvaluableError, match=f"none of {len(splats)} is labelled object, human; give a scene"):
        run(scored, out=scored / "out")
    assert [path.name for path in scored.iterdir()] == ["scene"]


def test_the_output_folder_holds_scores_rows_pictures_and_the_run(scored: Path) -> None:
    result = run(scored, out=scored / "score")
    assert result.out == scored / "score"
    names = sorted(path.name for path in result.out.iterdir())
    assert names == ["cam3_best_worst.png", "run.json", "score.json", "views.csv"]
    rows = list(csv.DictReader((result.out / "views.csv").read_text().splitlines()))
    report = json.loads((result.out / "score.json").read_text())
    assert report == result.report
    assert [row["view"] for row in rows] == [view["view"] for view in report["views"]]
    assert float(rows[0]["psnr_all"]) == report["views"][0]["psnr_all"]
    assert rows[2]["psnr_seen"] == ""
    run_json = json.loads((result.out / "run.json").read_text())
    assert run_json["metrics"] == report["metrics"]
    assert set(run_json["inputs"]) == {"fake", "scene/splats.ply"}


def test_a_view_whose_psnr_is_infinite_lets_no_gate_pass(scored: Path) -> None:
    result = run(scored, require=("psnr_all>=1",))
    assert result.report["views"][2]["psnr_all"] is None, "a black view of nothing, rendered black"
    assert result.verdict.exit_code == 5
    assert "psnr_all is unknown" in result.verdict.sentence


def test_a_training_camera_is_scored_only_when_allowed(scored: Path) -> None:
    with pytest.raises(UsageError, match="--cameras cam0: cam0 trained the scene"):
        run(scored, cameras=("cam0",))
    (view,) = run(scored, cameras=("cam0",), allow_training=True).report["views"]
    assert view["seen_share"] == view["valid_share"]


UNSEEN = r"no pixel of cam3 was seen by a training camera \(cam0\); is it"


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (FRAMES[:2], "no view of cam3 to score; 1 lie before the first snapshot"),
        ([frame(2 * SECOND, "cam3", SIDE)], UNSEEN),
        ([frame(2 * SECOND, "cam0", AWAY), frame(2 * SECOND, "cam3", SIDE)], UNSEEN),
        ([frame(2 * SECOND, "cam0", FRONT), frame(2 * SECOND, "cam3", AWAY)], UNSEEN),
    ],
)
def test_views_before_the_first_snapshot_or_that_no_training_camera_saw_cannot_be_scored(
    scored: Path, monkeypatch: pytest.MonkeyPatch, frames: list[RgbdFrame], words: str
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=frames))
    with pytest.raises(NotEvaluableError, match=words):
        run(scored, out=scored / "score")
    assert not (scored / "score").exists()


def test_a_recording_of_training_cameras_alone_is_refused(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_up(monkeypatch, FakeScene(cameras=("cam0", "cam3")), FakeSource(frames=FRAMES))
    with pytest.raises(
        UsageError, match=r"each camera has the name of one that trained the scene \(cam0, cam3\); giv"
    ):
        run(scored)


def test_a_dtu_scan_is_scored_on_the_views_held_out(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = [
        DtuView(name=f.camera, color=f.color, depth=f.depth, intrinsics=f.intrinsics, T_world_camera=f.T_world_camera)
        for f in (frame(0, "a", FRONT), frame(1, "b", SIDE, 0.1), frame(2, "c", FRONT))
    ]
    write_dtu(scored / "dtu", "scan1", views)
    set_up(monkeypatch, FakeScene(cameras=("camera",), has_clock=False, snapshots=()), FakeSource(frames=[]))
    held_out = RecordingRequest(path=scored / "dtu", is_dtu=True, options=SourceOptions(holdout=("1",)))
    report = score(ScoreRequest(scene=scored / "scene", recording=held_out)).report
    (view,) = report["views"]
    assert (view["view"], view["camera"], report["training_cameras"]) == ("holdout-0001", "holdout", ["camera"])
    assert view["psnr_seen"] == pytest.approx(20.0, abs=0.6)
    assert view["depth_median_seen"] < 1e-5
    assert view["seen_share"] > 0.8
    whole = RecordingRequest(path=scored / "dtu", is_dtu=True)
    with pytest.raises(
        UsageError, match=r"each camera has the name of one that trained the scene \(camera\); give the"
    ):
        score(ScoreRequest(scene=scored / "scene", recording=whole))


def test_what_lies_in_free_space_is_scored(scored: Path) -> None:
    metrics = run(scored).metrics
    assert metrics["in_front_seen"] == metrics["in_front_all"] == 0.0
    assert metrics["free_mass"] is None  # no occupancy.npz
    (scored / "scene" / "occupancy.npz").touch()
    assert run(scored).metrics["free_mass"] == pytest.approx(0.5, abs=0.05)


def test_a_render_before_the_recorded_surface_is_in_front(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    late = frame(3 * SECOND, "cam3", SIDE)
    late.depth[late.depth > 0] += 0.05
    seen = frame(3 * SECOND, "cam0", FRONT)
    set_up(monkeypatch, FakeScene(), FakeSource(frames=[seen, frame(2 * SECOND, "cam3", SIDE), late]))
    assert [view["in_front_all"] for view in run(scored).report["views"]] == [0.0, 1.0]


def test_what_no_splat_covers_shows_the_background_of_the_scene(
    scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(monkeypatch, FakeScene(background=(0.0, 1.0, 0.0)), FakeSource(frames=FRAMES))
    away = run(scored).report["views"][2]
    assert away["psnr_all"] == pytest.approx(10 * np.log10(3), abs=0.01), "green before a black view of nothing"
