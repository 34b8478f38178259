"""``score`` by named protocols, in both layouts of DTU, with masks, a cloud, and recordings that are others."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.cli.reconstruct import lines_of
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.held_out_depth import space_out
from splatctrl_cli.evaluate.protocols import score_protocol
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, is_folder_of_views
from splatctrl_cli.jobs.score.reference import missing_views
from splatctrl_cli.jobs.score.score import ScoreRequest, score
from splatctrl_cli.jobs.score.views import CloudSettings
from splatctrl_cli.recording.folder.dtu import DtuView, read_dtu, write_dtu
from splatctrl_cli.recording.folder.idr import DtuSource, write_idr
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64
from tests.evaluate.test_protocols import write_observed
from tests.jobs.stage import patch_json
from tests.recording.folder.make_layout import half_size
from tests.refused import expect_refusal

QUICK = ("-q", "--max-splats", "600", "--set", "scene.first_iterations=8", "--set", "scene.refine_iterations=4")
HOLDOUT = "holdout:every4"


@pytest.fixture(scope="module")
def views(request: pytest.FixtureRequest) -> list[DtuView]:
    sample_data: Path = request.getfixturevalue("sample_data")
    return [half_size(view) for view in read_dtu(sample_data / "dtu").views]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, views: list[DtuView]) -> Path:
    """A scan in both layouts, and a scene of it by HOLDOUT."""
    folder = tmp_path_factory.mktemp("protocol")
    write_dtu(folder / "mvsnet", "scan1", views)
    write_idr(folder / "idr", "scan1", views)
    shutil.rmtree(write_idr(folder / "blind", "scan1", views) / "depth")
    for number, view in enumerate(views):
        (folder / "masks").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "masks" / f"{number:03d}.png"), np.where(view.mask, 255, 0).astype(np.uint8))
    arguments = ["reconstruct", "--dtu", str(folder / "mvsnet"), "--protocol", HOLDOUT, "-o", str(folder / "scene")]
    assert main([*arguments, *QUICK]) == 0
    return folder


def scored(
    place: Path, root: str | Path, protocol: str = HOLDOUT, *, masks: Path | None = None, **changes: Any
) -> JudgedResult:
    """The scene of `place` against a scan in its folder `root`."""
    recording = RecordingRequest(path=place / root, is_dtu=True, protocol=protocol, masks=masks)
    return score(ScoreRequest(**{"scene": place / "scene", "recording": recording, **changes}))


def test_a_scan_scores_the_same_through_both_layouts(place: Path) -> None:
    one = scored(place, "mvsnet", masks=place / "masks").document
    other = scored(place, "idr").document
    told = [(found["protocol"]["layout"], found["protocol"]["mask_rule"]) for found in (one, other)]
    assert told == [("MVSNet's", "object mask"), ("IDR's", "object mask")]
    assert {view["view"] for view in one["views"]} == {"holdout-0000", "holdout-0004"}
    assert one["metrics"] == pytest.approx(other["metrics"], rel=1e-9)
    assert 10 < one["metrics"]["psnr_masked"] < 60
    first = json.loads((place / "scene" / "run.json").read_text())["metrics"]["first_frames"]
    assert [(kept["camera"], kept["stamp_ns"]) for kept in first] == [("camera", 1)]
    assert one["recording"]["differences"] == other["recording"]["differences"] == []


def test_without_depth_colours_are_scored_and_nothing_counts_as_seen(place: Path) -> None:
    metrics, with_depth = scored(place, "blind").metrics, scored(place, "idr").metrics
    assert metrics["psnr_seen"] is None and metrics["depth_median_all"] is None
    names = ("psnr_masked", "psnr_all", "ssim_published")
    assert [metrics[name] for name in names] == pytest.approx([with_depth[name] for name in names], abs=1e-9)


def test_a_scan_without_depth_is_not_reconstructed_without_points(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reconstruct", "--dtu", str(place / "blind"), "-o", str(tmp_path / "scene"), *QUICK]
    assert main(words) == 4
    assert "has no depth; give --depths DIR, or --points FILE.ply instead" in capsys.readouterr().err
    assert main([*words, "--depths", str(place / "mvsnet" / "Depths_raw" / "scan1")]) == 0


def test_the_report_says_by_what_its_figures_came_about(place: Path) -> None:
    result = scored(place, "idr").document
    out, protocol = "\n".join(lines_of(result)), result["protocol"]
    for words in (
        "\nprotocol: holdout:every4 (a rule given by hand)\n",
        "\nsplit: train 1-3, 5-7; score 0, 4\n",
        "mask rule: object mask; averaging: mean over the views; resolution: 128x104; backgr",
    ):
        assert words in out
    assert "dB mask" in out.splitlines()[0]
    assert " ".join(result) == (
        "scene reference cameras training_cameras has_clock snapshots recording protocol metrics"
        " warnings skipped_views views"
    )
    assert " ".join(protocol) == (
        "name source layout training_views scored_views left_out_views split mask_rule resolution"
        " published_resolution published_scans background averaging definitions"
    )
    assert (protocol["training_views"], protocol["scored_views"]) == ([1, 2, 3, 5, 6, 7], [0, 4])
    assert len(protocol["background"]) == 3


@pytest.mark.parametrize(
    ("protocol", "words"),
    [
        (
            "dtu-train",
            r"protocol dtu-train trains on 8 views \(train 0-7; score 0-7\), of which 2 did not train the scene.*"
            "and 0 others did; reconstruct with --protocol dtu-train",
        ),
        ("holdout:2,6", "of which 2 did not train the scene, and 2 others did"),
        ("regnerf", "did you mean regnerf-"),
    ],
)
def test_a_protocol_of_another_split_or_that_is_none_is_refused(place: Path, protocol: str, words: str) -> None:
    expect_refusal(words, scored, place, "mvsnet", protocol, error=UsageError)


def test_a_protocol_that_holds_out_twice_is_refused(place: Path) -> None:
    held_out = SourceOptions(holdout=("1",))
    twice = RecordingRequest(path=place / "mvsnet", is_dtu=True, protocol=HOLDOUT, options=held_out)
    words = "--holdout: the protocol holds views out already"
    expect_refusal(words, scored, place, "mvsnet", recording=twice, error=UsageError)


def test_images_in_a_folder_are_told_from_logs_and_captures(tmp_path: Path) -> None:
    for name, content in (("views/transforms.json", "{}"), ("capture/capture.json", "{}"), ("bag/metadata.yaml", "")):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(content)
    names = ("views", "capture", "bag", "log.mcap", "views.toml")
    assert [is_folder_of_views(tmp_path / name) for name in names] == [True, False, False, False, True]


@pytest.mark.parametrize(
    ("images", "names"),
    [
        ("all", {"views/holdout-0000.png", "views/holdout-0004.png", "holdout_best_worst.png"}),
        ("best-worst", {"holdout_best_worst.png"}),
        ("none", set()),
    ],
)
def test_pictures_of_every_view_of_the_extremes_or_none(
    place: Path, tmp_path: Path, images: str, names: set[str]
) -> None:
    scored(place, "mvsnet", images=images, out=tmp_path / "out")
    assert {str(path.relative_to(tmp_path / "out")) for path in tmp_path.rglob("*.png")} == names


def test_warnings_are_noted_counted_and_can_be_gated(place: Path, tmp_path: Path) -> None:
    for path in (place / "masks").iterdir():
        cv2.imwrite(str(tmp_path / path.name), 255 - cv2.imread(str(path)))  # type: ignore[operator]
    result = scored(place, "mvsnet", masks=tmp_path, require=("num_warnings<=0",))
    assert result.verdict.exit_code == 1
    assert result.verdict.shown[0].sentence.startswith("holdout-0000 has its mask on 100% of the image's border")
    assert "num_warnings is 1, required <= 0" in result.verdict.sentence
    assert scored(place, "mvsnet", require=("num_warnings<=0",)).notes == ()


def test_figures_are_compared_with_those_of_an_earlier_score(place: Path, tmp_path: Path) -> None:
    earlier = dict(scored(place, "mvsnet").document)
    earlier["metrics"]["psnr_all"] += 1.5
    path = tmp_path / "score.json"
    path.write_text(json.dumps(earlier))
    gates = ("change_psnr_all>=-1", "change_ssim_all>=0")
    result = scored(place, "mvsnet", baseline=path, require=gates)
    assert result.verdict.sentence.startswith(
        "score: GATE FAILED (2 views): --require change_psnr_all>=-1: change_psnr_all"
    )
    assert result.verdict.sentence.endswith(" is -1.5, required >= -1")
    (change,) = [line.split() for line in lines_of(result.document) if line.startswith("change")]
    assert change[1:6] == ["-", "+0.00", "-1.50", "+0.0000", "+0.0000"]
    words = "change_psnr_all>=-1: a figure of --baseline; give it"
    expect_refusal(words, scored, place, "mvsnet", require=gates, error=UsageError)
    words = "not comparable: mask_rule: expected object mask, got none; score the base"
    expect_refusal(words, scored, place, "mvsnet", masks=place / "masks", baseline=path)
    path.write_text("{}")
    words = r"score\.json: expected the score\.json of an earlier score"
    expect_refusal(words, scored, place, "mvsnet", baseline=path)


def test_views_that_are_missing_are_named(place: Path, views: list[DtuView], tmp_path: Path) -> None:
    write_dtu(tmp_path / "dtu", "scan1", views)
    (tmp_path / "dtu/Depths_raw/scan1/depth_map_0004.pfm").unlink()
    expect_refusal(
        "of which 0 did not train the scene, and 1 others did",
        scored,
        place,
        tmp_path / "dtu",
        "holdout:every5",
        error=UsageError,
    )
    expect_refusal("got no view 4; the scan has views 0-3, 5-7", scored, place, tmp_path / "dtu", "holdout:0,4")
    reference = DtuSource(tmp_path / "dtu", protocol=score_protocol("holdout:every5"))
    first, second = missing_views(reference, score_protocol("holdout:every5"))
    assert first.startswith("dtu/scan1: views 4 are not there: 'holdout:every5' counts those that are, and scores")
    assert second == "rect_005_3_r5000.png: without depth, left out"
    assert not [*missing_views(DtuSource(place / "mvsnet"), score_protocol("holdout:every5"))]


def surface(views: list[DtuView]) -> Float64:
    """What the views' depth measured [m], world."""
    parts = []
    for view in views:
        k, (v, u) = view.intrinsics, np.mgrid[: view.intrinsics.height : 2, : view.intrinsics.width : 2]
        z = view.depth[::2, ::2].astype(np.float64)
        points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=-1)[z > 0]
        parts.append(points @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3])
    return np.concatenate(parts)


def figures(result: JudgedResult) -> dict[str, float]:
    """The metrics that have a value."""
    return {name: value for name, value in result.metrics.items() if value is not None}


def write_cloud(path: Path, points: Float64) -> Path:
    rows = "\n".join(" ".join(f"{value:.6f}" for value in point) for point in points)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    properties = "".join(f"property float {name}\n" for name in "xyz")
    path.write_text(f"{header}{properties}end_header\n{rows}\n", encoding="ascii")
    return path


def test_the_surface_is_compared_with_a_cloud_in_millimetres(
    place: Path, views: list[DtuView], tmp_path: Path
) -> None:
    cloud = write_cloud(tmp_path / "cloud.ply", 1000 * surface(views[:3]))
    settings = CloudSettings(path=cloud, unit=0.001, spacing=0.004)
    result = scored(place, "mvsnet", cloud=settings, require=("chamfer<=0.02", "accuracy>0"))
    metrics, out = figures(result), "\n".join(lines_of(result.document))
    assert result.verdict.exit_code == 0
    assert 0.0005 < metrics["accuracy"] < 0.012 and 0.0005 < metrics["completeness"] < 0.012
    assert metrics["chamfer"] == pytest.approx((metrics["accuracy"] + metrics["completeness"]) / 2)
    assert metrics["completeness_seen_beyond"] < metrics["completeness_beyond"] + 1e-9
    assert "surface: accuracy " in out and "1 unit = 0.001 m; points 4 mm apart; means below 20 mm" in out
    blind = figures(scored(place, "blind", cloud=settings))
    assert blind["accuracy"] == pytest.approx(metrics["accuracy"], rel=1e-3), "the surface is rendered, not recorded"
    near = figures(scored(place, "mvsnet", cloud=replace(settings, max_distance=0.004)))
    assert near["accuracy"] < metrics["accuracy"] and near["accuracy_beyond"] > metrics["accuracy_beyond"]


def test_the_surface_is_compared_where_dtus_own_evaluation_looks(
    place: Path, views: list[DtuView], tmp_path: Path
) -> None:
    points = surface(views[:3])
    write_cloud(tmp_path / "stl001_total.ply", 1000 * points)
    middle = 1000 * np.median(points, axis=0)
    middle[2] = 30.0  # above the table
    write_observed(tmp_path, 1, middle - 100, middle + 100)
    settings = CloudSettings(path=tmp_path, unit=0.001, spacing=0.004)
    whole = figures(scored(place, "mvsnet", cloud=settings))
    result = scored(place, "mvsnet", cloud=replace(settings, masks=tmp_path))
    metrics = figures(result)
    assert 100 < metrics["num_points"] < 0.5 * whole["num_points"]
    above = space_out(points, 0.004)[:, 2] > 0.03
    assert metrics["num_reference"] == pytest.approx(np.count_nonzero(above), rel=0.05)
    assert "within the masks and above the planes of" in result.document["protocol"]["definitions"]["cloud"]
    expect_refusal("", scored, place, "mvsnet", cloud=CloudSettings(path=tmp_path / "masks.ply"))
    expect_refusal(
        r"ObsMask1_10\.mat: no such file; give the folder ObsMask",
        scored,
        place,
        "mvsnet",
        cloud=replace(settings, masks=place),
    )


def test_the_surface_is_compared_with_a_mesh(place: Path, views: list[DtuView], tmp_path: Path) -> None:
    corners = np.median(surface(views), axis=0) + 0.1 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = tmp_path / "plane.obj"
    mesh.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\nf 1 3 4\n", encoding="ascii")
    metrics = figures(scored(place, "mvsnet", cloud=CloudSettings(path=mesh, spacing=0.005, max_distance=0.1)))
    assert metrics["num_reference"] == pytest.approx(0.55 * 0.04 / 0.005**2, rel=0.1), "a spacing apart"
    assert 0 < metrics["completeness"] < 0.1


def test_another_scan_of_the_same_camera_names_is_refused_with_figures(
    place: Path, views: list[DtuView], tmp_path: Path
) -> None:
    moved = [replace(v, T_world_camera=pose_at([0.02, 0.0, 0.0]) @ v.T_world_camera) for v in views]
    write_dtu(tmp_path / "other", "scan1", moved)
    words = f"not the recording that {place / 'scene'} was made from: 8 of 32 files have other contents, such as"
    said = expect_refusal(words, scored, place, tmp_path / "other")
    assert "; camera: the pose differs by 20 mm and 0.0 degrees; give that recording, or --allow-other-rec" in said


def test_another_recording_may_be_scored_and_is_named(place: Path, views: list[DtuView], tmp_path: Path) -> None:
    write_dtu(tmp_path / "other", "scan1", [replace(view, color=view.color // 2) for view in views])
    expect_refusal("camera: the picture differs by up to ", scored, place, tmp_path / "other")
    result = scored(place, tmp_path / "other", allow_other_recording=True)
    assert any(note.startswith("another recording: camera: the picture differs by up to") for note in result.notes)


def test_a_scene_without_first_frames_is_told_by_the_digests_of_its_files(
    place: Path, views: list[DtuView], tmp_path: Path
) -> None:
    shutil.copytree(place / "scene", tmp_path / "scene")
    path = tmp_path / "scene" / "run.json"
    patch_json(path, lambda run: run | {"metrics": {k: v for k, v in run["metrics"].items() if k != "first_frames"}})
    result = scored(place, "mvsnet", scene=tmp_path / "scene")
    assert result.document["recording"]["basis"] == ["digests of 32 files of the same names"]
    write_dtu(tmp_path / "other", "scan1", [replace(view, color=view.color // 2) for view in views])
    changed = "8 of 32 files have other contents, such as Rectified/scan1_train/rect_001_3_r5000.png"
    expect_refusal(changed, scored, place, tmp_path / "other", scene=tmp_path / "scene")
