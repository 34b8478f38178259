"""`score` on scenes whose scores are known: of one log, of a session, and of other programs' splats."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.evaluate.views import psnr
from splatctrl_cli.formats.splat.gaussian_ply import write_gaussian_ply
from splatctrl_cli.formats.splat.splats import FORMATS, as_gaussians, write_ply
from splatctrl_cli.jobs.bake.request import read_bake_source
from splatctrl_cli.jobs.compare.compare import CompareRequest, compare
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest
from splatctrl_cli.jobs.recordings.provenance import first_frame
from splatctrl_cli.jobs.score import reference as score_reference
from splatctrl_cli.jobs.score import score as score_job
from splatctrl_cli.jobs.score.score import ScoreRequest, score
from splatctrl_cli.jobs.score.views import CloudSettings
from splatctrl_cli.recording.container.raw_log import RawMessage
from splatctrl_cli.recording.folder.dtu import DtuView, write_dtu
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import GaussianSet, Label, RgbdFrame, SplatSet
from splatctrl_cli.scene.render import render_gaussians
from tests.jobs.score.wall import (
    AWAY,
    FRAMES,
    FRONT,
    INTRINSICS,
    SECOND,
    SIDE,
    FakeScene,
    FakeSnapshot,
    FakeSource,
    frame,
    set_up,
    wall,
    write_scene,
)
from tests.recording.log.make_log import FRAME_NS, START_NS, LogRecipe, make_log, messages_of, write_raw
from tests.refused import expect_refusal

ROBOTS = np.full(len(wall()), Label.ROBOT, np.uint8)


@pytest.fixture
def scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, and the recording FRAMES."""
    return write_scene(tmp_path, monkeypatch)


def run(folder: Path, cameras: tuple[str, ...] | None = None, **changes: Any) -> JudgedResult:
    recording = RecordingRequest(path=Path("fake.mcap"), options=SourceOptions(cameras=cameras))
    return score(ScoreRequest(scene=folder / "scene", recording=recording, **changes))


def test_views_are_rendered_from_the_newest_snapshot_early_ones_counted_and_seen_pixels_told(scored: Path) -> None:
    result = run(scored)
    assert (result.document["cameras"], result.document["skipped_views"]) == (["cam3"], ["cam3-0000"])
    dark, right, away = result.document["views"]
    assert (dark["view"], right["view"], away["view"]) == ("cam3-0001", "cam3-0002", "cam3-0003")
    assert dark["psnr_all"] == pytest.approx(20.0, abs=0.6), "0.4 instead of 0.5"
    assert right["psnr_all"] == pytest.approx(40.0, abs=2.5), "off by 0.01, and rounded to 8 bits"
    assert right["seen_share"] == pytest.approx(58 / 64, abs=0.03), "the view is moved by 0.1 m, 6 pixels"
    assert right["depth_median_all"] < 1e-6
    assert [away[name] for name in ("seen_share", "psnr_seen", "depth_median_all")] == [0.0, None, None]
    assert (result.metrics["num_views"], result.metrics["num_skipped"], result.notes) == (3, 1, ())
    assert (result.verdict.counts["psnr_all"], result.verdict.counts["psnr_seen"]) == (2, 2)


def test_final_splats_serve_all_views_when_asked(scored: Path) -> None:
    first, *_ = run(scored, newest=False).document["views"]
    assert first["psnr_all"] > 50


def test_without_a_clock_every_view_is_scored_from_the_final_splats(
    scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(monkeypatch, FakeScene(has_clock=False, snapshots=()), FakeSource(frames=FRAMES, has_clock=False))
    report = run(scored).document
    assert (report["snapshots"], report["metrics"]["num_skipped"], len(report["views"])) == ("final", 0, 4)


@pytest.mark.parametrize("splats", [wall().select(np.zeros(len(wall()), bool)), replace(wall(), labels=ROBOTS)])
def test_a_scene_without_a_splat_that_counts_is_not_evaluable_and_leaves_nothing(
    scored: Path, monkeypatch: pytest.MonkeyPatch, splats: SplatSet
) -> None:
    monkeypatch.setattr(FakeScene, "splats", lambda scene: splats)
    words = f"none of {len(splats)} is labelled object, human; give a scene"
    expect_refusal(words, run, scored, out=scored / "out", error=NotEvaluableError)
    assert [path.name for path in scored.iterdir()] == ["scene"]


def test_the_output_folder_holds_scores_rows_pictures_and_the_run(scored: Path) -> None:
    result, out = run(scored, out=scored / "score"), scored / "score"
    names = sorted(path.name for path in result.out.iterdir())
    assert (result.out, names) == (out, ["cam3_best_worst.png", "run.json", "score.json", "views.csv"])
    rows = list(csv.DictReader((out / "views.csv").read_text().splitlines()))
    report, run_json = (json.loads((out / name).read_text()) for name in ("score.json", "run.json"))
    assert (report, run_json["metrics"]) == (result.document, report["metrics"])
    assert [row["view"] for row in rows] == [view["view"] for view in report["views"]]
    assert (float(rows[0]["psnr_all"]), rows[2]["psnr_seen"]) == (report["views"][0]["psnr_all"], "")
    assert compare(CompareRequest(runs=(out, out))).metrics["num_figures"] > 5
    assert set(run_json["inputs"]) == {"fake", "scene/splats.ply"}


def test_a_view_whose_psnr_is_infinite_lets_no_gate_pass(scored: Path) -> None:
    result = run(scored, require=("psnr_all>=1",))
    assert result.document["views"][2]["psnr_all"] is None, "a black view of nothing, rendered black"
    assert result.verdict.exit_code == 5 and "psnr_all is unknown" in result.verdict.sentence


def test_a_training_camera_is_scored_only_when_allowed(scored: Path) -> None:
    expect_refusal("--cameras cam0: cam0 trained the scene", run, scored, cameras=("cam0",), error=UsageError)
    (view,) = run(scored, cameras=("cam0",), allow_training=True).document["views"]
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
    expect_refusal(words, run, scored, out=scored / "score", error=NotEvaluableError)
    assert not (scored / "score").exists()


def test_a_dtu_scan_is_scored_on_the_views_held_out(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = [
        DtuView(name=f.camera, color=f.color, depth=f.depth, intrinsics=f.intrinsics, T_world_camera=f.T_world_camera)
        for f in (frame(0, "a", FRONT), frame(1, "b", SIDE, 0.1), frame(2, "c", FRONT))
    ]
    write_dtu(scored / "dtu", "scan1", views)
    set_up(monkeypatch, FakeScene(cameras=("camera",), has_clock=False, snapshots=()), FakeSource(frames=[]))
    held_out = RecordingRequest(path=scored / "dtu", is_dtu=True, options=SourceOptions(holdout=("1",)))
    report = score(ScoreRequest(scene=scored / "scene", recording=held_out)).document
    (view,) = report["views"]
    assert (view["view"], view["camera"], report["training_cameras"]) == ("holdout-0001", "holdout", ["camera"])
    assert view["psnr_seen"] == pytest.approx(20.0, abs=0.6)
    assert view["depth_median_seen"] < 1e-5 and view["seen_share"] > 0.8
    whole = ScoreRequest(scene=scored / "scene", recording=RecordingRequest(path=scored / "dtu", is_dtu=True))
    words = r"each camera has the name of one that trained the scene \(camera\); give the"
    expect_refusal(words, score, whole, error=UsageError)


def test_what_lies_in_free_space_is_scored(scored: Path) -> None:
    metrics = run(scored).metrics
    assert metrics["in_front_seen"] == metrics["in_front_all"] == 0.0
    assert metrics["free_mass"] is None  # no occupancy.npz
    (scored / "scene" / "occupancy.npz").touch()
    assert run(scored).metrics["free_mass"] == pytest.approx(0.5, abs=0.05)


def test_a_render_before_the_recorded_surface_is_in_front(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    late = frame(3 * SECOND, "cam3", SIDE)
    late.depth[late.depth > 0] += 0.05
    frames = [frame(3 * SECOND, "cam0", FRONT), frame(2 * SECOND, "cam3", SIDE), late]
    set_up(monkeypatch, FakeScene(), FakeSource(frames=frames))
    assert [view["in_front_all"] for view in run(scored).document["views"]] == [0.0, 1.0]


def test_what_no_splat_covers_shows_the_background_of_the_scene(
    scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(monkeypatch, FakeScene(background=(0.0, 1.0, 0.0)), FakeSource(frames=FRAMES))
    away = run(scored).document["views"][2]
    assert away["psnr_all"] == pytest.approx(10 * np.log10(3), abs=0.01), "green before a black view of nothing"


Keep = Callable[[RawMessage], bool]


def of(*words: str) -> Keep:
    return lambda message: any(word in message.topic.name for word in words)


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """a.mcap with cam0 and all of tf, b.mcap with cam1; and a scene that cam0 trained."""
    whole = make_log(tmp_path / "whole.mcap", LogRecipe(cameras=("cam0", "cam1")))
    for name, keep in (("a", of("cam0", "tf")), ("b", of("cam1"))):
        write_raw(tmp_path / f"{name}.mcap", filter(keep, messages_of(whole)))
    first = next(r for r in open_source(tmp_path / "a.mcap").records() if isinstance(r, RgbdFrame))
    snapshots = (FakeSnapshot(stamp_ns=START_NS), FakeSnapshot(stamp_ns=START_NS + 2 * FRAME_NS))
    scene = FakeScene(snapshots=snapshots)
    scene.run |= {"metrics": {"first_frames": [dict(first_frame(first))]}}
    (tmp_path / "scene").mkdir()
    write_ply(tmp_path / "scene" / "splats.ply", wall(), {})
    monkeypatch.setattr(score_job, "open_splats", lambda path: scene)
    return tmp_path


def run_session(folder: Path, *names: str) -> JudgedResult:
    first, *beside = (folder / name for name in names)
    recording = RecordingRequest(path=first, others=tuple(beside))
    return score(ScoreRequest(scene=folder / "scene", recording=recording, images="none"))


def test_a_camera_of_another_log_is_scored_beside_the_log_that_trained(session: Path) -> None:
    report = run_session(session, "a.mcap", "b.mcap").document
    told = report["cameras"], report["metrics"]["num_views"], report["reference"]
    assert told == (["cam1"], 5, f"{session / 'a.mcap'} + {session / 'b.mcap'}")
    assert report["metrics"]["seen_share"] > 0.99, "both cameras stand at one place"


def test_several_references_are_one_session(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [word for name in "ab" for word in ("--reference", str(session / f"{name}.mcap"))]
    assert main(["score", str(session / "scene"), *logs]) == 0
    assert "5 views scored" in capsys.readouterr().out


def test_the_other_log_alone_asks_for_the_one_that_trained(session: Path) -> None:
    whole = make_log(session / "whole.mcap", LogRecipe(cameras=("cam0", "cam1")))
    write_raw(session / "alone.mcap", filter(of("cam1", "tf"), messages_of(whole)))
    expect_refusal(
        r"has no camera cam0; give that recording, .* give both, each as --reference",
        run_session,
        session,
        "alone.mcap",
    )


def test_a_camera_that_no_transform_joins_to_the_world_is_refused_by_name(session: Path) -> None:
    alone = make_log(session / "apart.mcap", LogRecipe(cameras=("cam2",), has_tf=False))
    expect_refusal(r"camera cam2: no tf for frame 'cam2_optical'", run_session, session, "a.mcap", alone.name)


def test_a_camera_of_another_time_is_refused_by_name(session: Path) -> None:
    path = make_log(session / "late.mcap", LogRecipe(cameras=("cam1",), num_frames=40, tf_frames=40))
    late = [m for m in messages_of(path) if m.log_time_ns > START_NS + 10 * FRAME_NS or "static" in m.topic.name]
    write_raw(path, late)
    line = (
        f"camera cam1: expected frames between those that trained, {START_NS} to {START_NS + 4 * FRAME_NS} ns, got"
        f" {START_NS + 11 * FRAME_NS} to {START_NS + 39 * FRAME_NS} ns; give logs of the same time and clock"
    )
    expect_refusal(line, run_session, session, "a.mcap", path.name)


def test_a_log_beside_an_image_folder_is_refused(tmp_path: Path) -> None:
    expect_refusal(
        r"views.toml: expected a log, as the others are, got a folder of images",
        RecordingRequest,
        path=tmp_path / "views.toml",
        others=(tmp_path / "b.mcap",),
        error=UsageError,
    )


STRETCHED = np.array([1.0, 0.6, 1.4], np.float32)


@pytest.fixture
def one_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder; every recording is of one view from the side."""
    frames = [frame for frame in FRAMES if frame.camera == "cam3"][:1]
    monkeypatch.setattr(score_reference, "open_source", lambda path, options, **_: FakeSource(frames=frames))
    return tmp_path


def wall_with_harmonics() -> GaussianSet:
    """The wall, its Gaussians stretched and of another colour from each side."""
    round_ones = as_gaussians(wall())
    more = np.random.default_rng(0).uniform(-0.3, 0.3, (len(round_ones), 3, 3)).astype(np.float32)
    harmonics = np.concatenate([round_ones.harmonics, more], axis=1)
    return replace(round_ones, scales=round_ones.scales * STRETCHED, harmonics=harmonics)


def run_file(file: Path, **changes: object) -> JudgedResult:
    recording = RecordingRequest(path=file.parent / "fake.mcap")
    return score(ScoreRequest(scene=file, recording=recording, **changes))  # type: ignore[arg-type]


def test_stretched_gaussians_with_harmonics_are_scored_as_they_are(one_view: Path) -> None:
    gaussians = wall_with_harmonics()
    write_gaussian_ply(one_view / "other.ply", gaussians, {})
    result = run_file(one_view / "other.ply", out=one_view / "out")
    frame = next(frame for frame in FRAMES if frame.camera == "cam3")
    render = render_gaussians(gaussians, INTRINSICS, SIDE, threads=1).color
    assert result.metrics["psnr_all"] == pytest.approx(psnr(np.clip(render, 0, 1), frame.color / 255.0), abs=0.01)
    assert (one_view / "out" / "score.json").is_file()
    assert "does not say which views trained it" in result.notes[0] and result.metrics["psnr_seen"] is None


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz"])
def test_round_splats_of_each_format_are_scored_and_have_distances(one_view: Path, suffix: str) -> None:
    file = one_view / f"other{suffix}"
    FORMATS[suffix].write(file, as_gaussians(wall()), {})
    assert (run_file(file).metrics["psnr_all"] or 0) > 35
    found = read_bake_source(file, None).splats
    assert found.centers == pytest.approx(wall().centers, abs=1e-3)
    assert found.radii == pytest.approx(wall().radii, rel=0.04)


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_colour_by_side_costs_no_distance_and_stretch_is_refused(tmp_path: Path, suffix: str) -> None:
    coloured = replace(wall_with_harmonics(), scales=as_gaussians(wall()).scales)
    file = tmp_path / f"other{suffix}"
    FORMATS[suffix].write(file, coloured, {})
    assert len(read_bake_source(file, None).splats) == len(coloured)
    FORMATS[suffix].write(file, wall_with_harmonics(), {})
    expect_refusal(
        r"whose scales differ.*'splatctrl export --isotropic' writes the nearest", read_bake_source, file, None
    )


def test_splats_in_another_unit_are_refused(one_view: Path) -> None:
    file = one_view / "other.ply"
    write_gaussian_ply(file, wall_with_harmonics(), {"units": "millimetre"})
    expect_refusal("comment 'units: millimetre': expected m", run_file, file)


def test_a_surface_cannot_be_looked_at_without_training_views(one_view: Path) -> None:
    write_gaussian_ply(one_view / "other.ply", wall_with_harmonics(), {})
    expect_refusal(
        "--cloud: the surface is looked at from the views that trained, which",
        run_file,
        one_view / "other.ply",
        cloud=CloudSettings(path=one_view / "cloud.ply"),
        error=UsageError,
    )
