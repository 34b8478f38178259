"""``--refine-poses``, exposure and corrected cameras, from the recording to the score."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.calibration.displacement import is_corrected
from splatctrl_cli.calibration.gray_views import exposed, exposure_gains
from splatctrl_cli.calibration.pose_refinement import unbent
from splatctrl_cli.cli.main import main
from splatctrl_cli.config import load_config
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import Outcome
from splatctrl_cli.formats.scene.scene_folder import SceneFolder, ViewCorrection
from splatctrl_cli.jobs.reconstruct.correct_views import Corrections, corrected, corrected_among
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest
from splatctrl_cli.jobs.replay.evidence_criteria import calibration
from splatctrl_cli.jobs.running.progress import SILENT
from splatctrl_cli.jobs.score import reference as score_reference
from splatctrl_cli.jobs.score.score import ScoreRequest, score
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from tests.calibration.scan import a_bend, bent, disturbed, gains_of, robot_in, shrink_refinement, views_of
from tests.jobs.replay.test_criteria import judged
from tests.jobs.score.wall import FakeSource
from tests.refused import expect_refusal

SMALL = ["scene.max_splats=1000", "scene.first_iterations=40", "scene.refine_iterations=80"]
HELD_OUT = 3
POSES, EXPOSURE = Corrections(poses=True), Corrections(exposure=True)


@pytest.fixture(scope="module")
def seven(sample_data: Path) -> list[RgbdFrame]:
    """As many as show a bend where one is held out."""
    return views_of(sample_data)[:7]


@pytest.fixture(scope="module")
def views(seven: list[RgbdFrame]) -> list[RgbdFrame]:
    return seven[::2]


def held_out(views: list[RgbdFrame]) -> list[RgbdFrame]:
    return [replace(view, camera="holdout") if k == HELD_OUT else view for k, view in enumerate(views)]


def request(
    views: list[RgbdFrame], out: Path, *, corrections: Corrections = POSES, has_clock: bool = False
) -> ReconstructRequest:
    return ReconstructRequest(
        source=FakeSource(frames=[view for view in views if view.camera != "holdout"], has_clock=has_clock),
        out=out,
        config=load_config(None, SMALL),
        corrections=corrections,
        allow_disagreement=True,
    )


def scored(folder: Path, frames: list[RgbdFrame], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The metrics of the scene in a folder on these frames."""
    monkeypatch.setattr(score_reference, "open_source", lambda *_, **__: FakeSource(frames=frames, has_clock=False))
    return dict(score(ScoreRequest(scene=folder / "scene", recording=RecordingRequest(path=folder))).metrics)


def test_a_view_held_out_is_scored_where_it_was_recorded_and_where_it_belongs(
    views: list[RgbdFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    off = held_out(disturbed(views, 15.0, 1.0))
    result = reconstruct(request(off, tmp_path / "scene"))
    assert result.metrics["pose_residual"] < 0.1 * result.metrics["poses"]["residual_before"]
    assert len(SceneFolder(tmp_path / "scene").corrections) == len(views) - 1
    metrics = scored(tmp_path, off, monkeypatch)
    assert metrics["psnr_all_corrected"] > metrics["psnr_all"] + 2.0
    assert metrics["depth_median_all_corrected"] < 0.5 * metrics["depth_median_all"]


def test_a_bent_depth_is_freed_in_the_map_and_in_the_corrected_figures_alone(
    seven: list[RgbdFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shrink_refinement(monkeypatch)
    off = held_out(bent(seven, a_bend(0.05)))
    result = reconstruct(request(off, tmp_path / "scene"))
    bend, scene = result.metrics["depth_bends"]["camera"], SceneFolder(tmp_path / "scene")
    assert result.metrics["depth_bend"] == scene.made_from["depth_bend"] == bend["largest"] > 0.02
    assert bend["residual_after"] < 0.1 * bend["residual_before"]
    assert any("corrected for a bend of at most" in reason.sentence for reason in result.verdict.reasons)
    for frame in off:
        if frame.camera != "holdout":
            free = corrected(frame, scene.corrections)
            assert np.array_equal(free.depth, unbent(frame, np.array(bend["offsets"])).depth)
    metrics = scored(tmp_path, off, monkeypatch)
    assert metrics["depth_median_all_corrected"] < 0.5 * metrics["depth_median_all"]


def test_where_a_robot_is_judged_depth_stays_as_it_was_recorded(
    seven: list[RgbdFrame], tmp_path: Path, plain_arm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shrink_refinement(monkeypatch)
    result = reconstruct(replace(request(bent(seven, a_bend(0.05)), tmp_path / "scene"), **robot_in(plain_arm)))
    assert result.metrics["pose_residual"] > 0 and result.metrics["depth_bend"] is None
    assert "depth_bends" not in result.metrics


def test_of_a_camera_that_did_not_train_no_bend_is_known(views: list[RgbdFrame]) -> None:
    bend = ViewCorrection(T_world_camera=None, gain=None, bend=a_bend(0.05))
    rig = [replace(view, camera=f"cam{k % 2}") for k, view in enumerate(views[1:])]
    for camera, trained, is_bent in (
        ("other", views[1:], False),
        ("holdout", views[1:], True),
        ("holdout", rig, False),
    ):
        view = replace(views[0], camera=camera)
        found = corrected_among(view, trained, {(each.camera, each.stamp_ns): bend for each in trained})
        assert np.array_equal(found.depth, unbent(view, a_bend(0.05)).depth if is_bent else view.depth)


def test_right_views_give_the_same_splats_with_and_without(views: list[RgbdFrame], tmp_path: Path) -> None:
    right = held_out(views)
    both, none = Corrections(poses=True, exposure=True), Corrections()
    with_, without = (reconstruct(request(right, tmp_path / str(bool(c)), corrections=c)) for c in (both, none))
    assert (with_.out / "splats.ply").read_bytes() == (without.out / "splats.ply").read_bytes()
    assert without.metrics["pose_residual"] is None and without.metrics["exposure_spread"] is None


def unlike(views: list[RgbdFrame]) -> list[RgbdFrame]:
    """Exposed each for itself."""
    gains = gains_of(len(views)) ** 1.5
    gains[HELD_OUT] = [1.3, 1.2, 1.1]
    return [exposed(view, 1 / gain) for view, gain in zip(views, gains, strict=True)]


@pytest.mark.parametrize("corrections", [EXPOSURE, Corrections()], ids=["asked for", "found"])
def test_a_view_held_out_is_scored_at_its_own_exposure_and_at_that_of_the_others(
    views: list[RgbdFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, corrections: Corrections
) -> None:
    off = held_out(unlike(views))
    result = reconstruct(request(off, tmp_path / "scene", corrections=corrections))
    assert result.metrics["exposure_spread"] > 0.1
    metrics = scored(tmp_path, off, monkeypatch)
    assert metrics["psnr_all_corrected"] > metrics["psnr_all"] + 1.0


def glossy(views: list[RgbdFrame]) -> list[RgbdFrame]:
    """Gloss and shadows that lie elsewhere in each image."""
    rng, found = np.random.default_rng(0), []
    for view in views:
        height, width = view.depth.shape
        light = np.exp(cv2.resize(0.4 * rng.normal(size=(3, 4)), (width, height), interpolation=cv2.INTER_LINEAR))
        found.append(replace(view, color=np.clip(view.color * light[..., None], 0, 255).astype(np.uint8)))
    return found


def test_exposures_are_found_where_whole_images_differ_and_no_robot_is_judged(seven: list[RgbdFrame]) -> None:
    def is_found(views: list[RgbdFrame], *, has_clock: bool = False, has_robot: bool = False) -> bool:
        source = FakeSource(frames=views, has_clock=has_clock)
        made, facts = Corrections().of(views, source, SILENT, has_robot=has_robot)
        is_same = all(np.array_equal(a.color, b.color) for a, b in zip(made, views, strict=True))
        assert is_same != ("exposure_spread" in facts)
        return not is_same

    alike = [exposed(view, np.full(3, 1 + 0.005 * k)) for k, view in enumerate(seven)]
    bare = [replace(view, depth=np.zeros_like(view.depth)) for view in unlike(seven)]
    assert is_found(unlike(seven))
    assert not any(is_found(views) for views in (alike, bare, glossy(seven)))
    assert not is_found(unlike(seven), has_clock=True) and not is_found(unlike(seven), has_robot=True)
    assert np.ptp(exposure_gains(glossy(seven))) > 0.1, "whole images seem to differ"


def test_a_view_that_cannot_be_put_right_is_named(views: list[RgbdFrame], tmp_path: Path) -> None:
    off = disturbed(views, 15.0, 1.0)
    away = off[2].T_world_camera.copy()
    away[:3, 3] += [30.0, 0.0, 0.0]
    off[2] = replace(off[2], T_world_camera=away)
    notes = [reason.sentence for reason in reconstruct(request(off, tmp_path / "scene")).verdict.reasons]
    assert any("not corrected" in note and f"at {off[2].stamp_ns}" in note for note in notes)


def test_what_nothing_tells_is_refused(views: list[RgbdFrame], tmp_path: Path) -> None:
    timed = request(views, tmp_path / "scene", has_clock=True)
    expect_refusal("recorded over time", reconstruct, timed, error=UsageError)
    bare = [replace(view, depth=np.zeros_like(view.depth)) for view in views]
    expect_refusal("depth", reconstruct, request(bare, tmp_path / "scene"))


SETTINGS = ("scene.max_splats=600", "scene.first_iterations=15", "scene.iterations_per_step=3")
FAST = ["--threads", "1", "-q", *(word for setting in SETTINGS for word in ("--set", setting))]
PERTURB = {"pose-error": 0.012, "pose-turn": 0.6, "seed": 5}


@pytest.fixture(scope="module")
def metrics(short_sample: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The metrics of a reconstruction of a log whose cameras are each 12 mm and 0.6 degrees off."""
    tabletop, out = short_sample / "tabletop", tmp_path_factory.mktemp("corrected") / "scene"
    words = [word for name, value in PERTURB.items() for word in ("--perturb", f"{name}={value}")]
    robot = ["--urdf", str(tabletop / "robot.urdf"), "--spheres", str(tabletop / "robot_spheres.yaml")]
    log = ["reconstruct", str(tabletop / "log.mcap"), "--cameras", "cam0,cam1", *words]
    assert main([*log, *robot, "-o", str(out), *FAST]) in (0, 3)
    found: dict[str, Any] = json.loads((out / "run.json").read_text())["metrics"]
    return found


def test_the_map_is_made_with_the_poses_at_which_the_cameras_truly_stand(
    metrics: dict[str, Any], short_sample: Path
) -> None:
    log, rows = short_sample / "tabletop" / "log.mcap", metrics["displaced_cameras"]
    true, off = (
        {camera: T for _, camera, T in open_source(log, options).poses()}
        for options in (SourceOptions(), SourceOptions(perturb=PERTURB))
    )
    assert set(rows) == set(metrics["cameras"])
    for camera, row in rows.items():
        placed = off[camera] @ np.array(row["T_recorded_camera"]).reshape(4, 4)
        assert placed == pytest.approx(true[camera], abs=2e-3)
    assert metrics["camera_displacement_mm"] == max(row["distance_mm"] for row in rows.values()) > 5.0
    assert metrics["self_mask_residual_mm"] < 2.0  # of cameras as recorded, 5 and more


def test_the_verdict_names_the_corrected_cameras_and_holds(metrics: dict[str, Any]) -> None:
    rows = metrics["displaced_cameras"]
    reasons = list(calibration(judged(figures={"displaced_cameras": rows})))
    assert all(is_corrected(row) for row in rows.values())
    told = [(reason.outcome, reason.is_note, reason.who) for reason in reasons]
    assert told == [(Outcome.PASSED, True, camera) for camera in rows]
    assert "its pose is corrected to within" in reasons[0].sentence
