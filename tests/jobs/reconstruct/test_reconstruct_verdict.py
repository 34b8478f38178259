"""What a reconstruction's verdict says of its map, each criterion alone; and views that do not fit together."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import Config, OccupancyConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import Outcome, Reason
from splatctrl_cli.jobs.reconstruct.verdict import GATED, Reconstructed, longest_blind, reconstruct_verdict
from splatctrl_cli.jobs.recordings.open_recording import CameraAgreement, RecordingRequest, open_to_train
from splatctrl_cli.jobs.running.progress import SILENT
from splatctrl_cli.records import LossReport, RecordSource, RgbdFrame
from splatctrl_cli.scene.time_steps import AuditRow, TimeStep
from tests.calibration.scan import views_of
from tests.refused import expect_refusal

TENTH = 100_000_000  # [ns]
CAMERAS = ("cam0", "cam1")


def row(step: int, *blind: str) -> AuditRow:
    counts = dict.fromkeys(("alive", "dead", "added", "relocated", "unmet", "evicted", "robot", "human"), 0)
    return AuditRow(
        **counts,
        stamp_ns=step * TENTH,
        cameras=CAMERAS,
        removed={},
        unrepresented=0,
        without_depth=len(blind),
        loss=None,
        psnr=20.0,
        blind=blind,
    )


def made(*rows: AuditRow, loss: LossReport | None = None, is_seeded: bool = False, **changed: Any) -> Reconstructed:
    metrics: dict[str, Any] = dict.fromkeys(GATED, 0) | {
        "cameras": list(CAMERAS),
        "has_clock": True,
        "time_steps": len(rows),
        "splats": 100,
        "robot_splats": 40,
        "camera_displacement_mm": None,
        "displaced_cameras": {},
        "self_mask": {"hand": {"median_mm": -1.0, "sign": -1, "num_pixels": 5000, "is_judged": True}},
        "self_mask_residual_mm": 1.0,
        "psnr": 20.0,
        "inside_robot_first_ns": None,
        "inside_robot_first_link": None,
        "carried": [],
        "repeated_frames": {},
        "frames_without_depth": sum(row.without_depth for row in rows),
    }
    return Reconstructed(
        metrics=metrics | changed, rows=rows, config=Config(), loss=loss or LossReport(), is_seeded=is_seeded
    )


STEPS = tuple(row(step) for step in range(30))


def notes(reconstructed: Reconstructed) -> tuple[Reason, ...]:
    verdict = reconstruct_verdict(reconstructed, [])
    assert (verdict.outcome, verdict.exit_code) == (Outcome.PASSED, 0)
    return verdict.shown


def test_a_sound_map_passes_without_a_note() -> None:
    verdict = reconstruct_verdict(made(*STEPS), [])
    sentence = "reconstruct: PASSED (30 time steps of cam0, cam1, 100 splats)"
    assert (verdict.sentence, verdict.shown, verdict.exit_code) == (sentence, (), 0)


OFF = {
    "left": {"distance_mm": 6.2, "sigma_mm": 1.1, "num_pixels": 5000},
    "right": {"distance_mm": 5.9, "sigma_mm": 1.0, "num_pixels": 4000},
}


def masks(hand_mm: float) -> dict[str, Any]:
    """The hand is measured that far behind; of the others one is near enough, and one hardly seen."""
    rows = {"hand": (hand_mm, 5000, True), "link1": (3.9, 5000, True), "link2": (50.0, 99, False)}
    names = ("median_mm", "num_pixels", "is_judged")
    return {link: dict(zip(names, row, strict=True)) | {"sign": 1} for link, row in rows.items()}


@pytest.mark.parametrize(
    ("changed", "facts", "words"),
    [
        ({"repeated_frames": {"cam1": 3}}, {}, "camera cam1: left out 3 frames that repeat the depth before them"),
        (
            {"unrepresented_voxels": 271, "unrepresented_volume": 271 * 0.02**3},
            {"value": 271, "remedy": "raise --max-splats above 5000"},
            "represented space: 271 voxels (2.17 l) are occupied and have no splat",
        ),
        (
            {"self_mask": masks(6.0)},
            {"who": "hand", "value": 6.0, "threshold": 4.0},
            "hand is measured 6.0 mm behind where its joints put it",
        ),
        (
            {"self_mask": masks(-6.0)},
            {"who": "hand", "value": -6.0, "threshold": 4.0},
            "hand is measured 6.0 mm before where its joints put it",
        ),
        (
            {"displaced_cameras": OFF},
            {"who": "left", "value": 6.2, "threshold": 5.0, "count": 5000},
            "left sees the robot 6.2 mm from where its joints put it",
        ),
        (
            {"inside_robot_points": 12, "inside_robot_first_ns": 7 * TENTH, "inside_robot_first_link": "link5"},
            {"who": "link5", "time_s": pytest.approx(0.7), "value": 12},
            "points inside the robot: 12 measured points",
        ),
    ],
    ids=["repeated", "no splat", "behind", "before", "camera", "inside"],
)
def test_what_is_wrong_with_a_map_is_noted_with_its_figures(
    changed: dict[str, Any], facts: dict[str, Any], words: str
) -> None:
    (said,) = notes(made(*STEPS, **changed))
    assert {name: getattr(said, name) for name in facts} == facts
    assert words in str(said)
    assert ("calibrate" in said.remedy) >= ("self_mask" in changed)


def test_an_empty_map_is_not_evaluable_and_balls_alone_are_no_empty_map() -> None:
    verdict = reconstruct_verdict(made(*STEPS, splats=40), [])
    assert (verdict.exit_code, verdict.label) == (5, "not evaluable")
    assert "map: expected splats of objects, got none; give a --box" in verdict.sentence
    assert notes(made(*STEPS, splats=40, unrepresented_voxels=1))


def test_a_camera_without_depth_for_longer_than_evidence_lasts_is_noted_with_its_times() -> None:
    blind = tuple(row(step, *(("cam1",) if 8 <= step <= 19 else ())) for step in range(30))
    (said,) = notes(made(*blind))
    assert (said.who, said.time_s, said.value) == ("cam1", pytest.approx(0.8), pytest.approx(1.1))
    assert "camera cam1 returned no depth from 0.80 to 1.90 s" in said.sentence
    short = tuple(row(step, *(("cam1",) if 8 <= step <= 18 and step != 13 else ())) for step in range(30))
    (said,) = notes(made(*short))
    assert (said.who, said.sentence) == ("", "10 frames have no depth, and seeded no splats")
    assert notes(made(*blind, is_seeded=True)) == (), "nobody looked at depth"
    (said,) = notes(made(*blind, has_clock=False))
    assert said.who == "", "views without a clock have no times"


def test_a_stretch_without_depth_ends_where_the_camera_sees_again() -> None:
    rows = [row(0, "cam0"), row(1), row(2, "cam0", "cam1"), row(3, "cam0"), row(4, "cam0")]
    assert longest_blind(rows) == {"cam0": (2 * TENTH, 4 * TENTH), "cam1": (2 * TENTH, 2 * TENTH)}


def test_a_link_within_its_tolerance_or_hardly_seen_is_not_noted() -> None:
    assert notes(made(*STEPS, self_mask=masks(0.0))) == ()


def test_what_the_input_lost_is_noted_and_damage_is_exit_3_below_everything_worse() -> None:
    loss = replace(LossReport(), damaged=1, notes=["chunk 3: its checksum differs"])
    verdict = reconstruct_verdict(made(*STEPS, loss=loss), [])
    assert [str(said) for said in verdict.shown] == ["input: chunk 3: its checksum differs"]
    assert (verdict.exit_code, verdict.as_dict()["exit_code"]) == (3, 3)
    assert reconstruct_verdict(made(*STEPS, loss=loss), ["psnr>=21"]).exit_code == 1
    assert reconstruct_verdict(made(*STEPS, loss=loss, splats=40), []).exit_code == 5
    assert reconstruct_verdict(made(*STEPS, loss=loss, splats=40), ["psnr>=21"]).exit_code == 1


@pytest.mark.parametrize("value", [None, float("nan"), float("inf")])
def test_a_gate_on_a_figure_that_is_not_there_is_not_evaluable_by_name(value: float | None) -> None:
    verdict = reconstruct_verdict(made(*STEPS, psnr=value), ["psnr<=30", "splats>=1"])
    assert (verdict.exit_code, verdict.decisive[0].criterion) == (5, "--require psnr<=30")
    assert "psnr is unknown, required <= 30" in verdict.sentence


def test_a_gate_on_an_unknown_figure_names_the_nearest() -> None:
    expect_refusal(
        "did you mean unrepresented_voxels",
        reconstruct_verdict,
        made(*STEPS),
        ["unrepresented_voxel<=0"],
        error=UsageError,
    )


def test_a_gate_on_points_inside_a_robot_that_no_pixel_showed_is_not_evaluable() -> None:
    gate = ["inside_robot_points<=0"]
    assert reconstruct_verdict(made(*STEPS), gate).exit_code == 0
    verdict = reconstruct_verdict(made(*STEPS, self_mask={}, self_mask_residual_mm=None), gate)
    assert verdict.exit_code == 5 and "inside_robot_points is unknown, as it rests on nothing" in verdict.sentence
    assert verdict.as_dict()["counts"]["splats"] == len(STEPS)


@pytest.fixture(scope="module")
def views(sample_data: Path) -> list[RgbdFrame]:
    """Of a still scene, from different places."""
    return views_of(sample_data)


@pytest.fixture(scope="module")
def scan(sample_data: Path) -> RecordSource:
    """What the views are of."""
    return open_to_train(RecordingRequest(path=sample_data / "dtu", is_dtu=True))


def check(scan: RecordSource, views: list[RgbdFrame], factor: float, *, is_allowed: bool = False) -> None:
    scaled = tuple(replace(view, depth=view.depth * np.float32(factor)) for view in views)
    made = CameraAgreement(scan, is_allowed=is_allowed, is_still=True)
    made.check(TimeStep(frames=scaled, position=None), OccupancyConfig(max_range=100.0), SILENT)


def test_views_at_their_own_scale_pass(scan: RecordSource, views: list[RgbdFrame]) -> None:
    check(scan, views, 1.0)


@pytest.mark.parametrize("factor", [10.0, 0.1])
def test_depths_ten_times_too_far_or_near_are_refused_with_the_option_to_give(
    scan: RecordSource, views: list[RgbdFrame], factor: float
) -> None:
    expect_refusal("; .*--depth-scale.*--allow-disagreement", check, scan, views, factor)
    check(scan, views, factor, is_allowed=True)
