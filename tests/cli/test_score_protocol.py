"""``score`` by named protocols, in both layouts of DTU, with masks, a cloud, and recordings that are others."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.datasets.dtu import DtuView, read_dtu, write_dtu
from splatctrl_cli.datasets.dtu_source import DtuSource
from splatctrl_cli.datasets.idr import write_idr
from splatctrl_cli.datasets.protocols import score_protocol
from splatctrl_cli.evaluate.cloud import spaced
from splatctrl_cli.jobs.recording import is_folder_of_views
from splatctrl_cli.jobs.score_reference import missing_views
from splatctrl_cli.records import Float64
from tests.datasets.make_idr import half_size
from tests.files.make_observed import write_observed

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
    write_idr(folder / "blind", "scan1", views, with_depth=False)
    for number, view in enumerate(views):
        (folder / "masks").mkdir(exist_ok=True)
        assert view.mask is not None
        cv2.imwrite(str(folder / "masks" / f"{number:03d}.png"), np.where(view.mask, 255, 0).astype(np.uint8))
    arguments = ["reconstruct", "--dtu", str(folder / "mvsnet"), "--protocol", HOLDOUT, "-o", str(folder / "scene")]
    assert main([*arguments, *QUICK]) == 0
    return folder


def run(place: Path, layout: str, *arguments: object) -> int:
    return main(["score", str(place / "scene"), "--dtu", str(place / layout), *map(str, arguments)])


def scored(capsys: pytest.CaptureFixture[str], place: Path, layout: str, *arguments: object) -> Any:
    capsys.readouterr()
    assert run(place, layout, "--protocol", HOLDOUT, "--json", *arguments) == 0
    return json.loads(capsys.readouterr().out)


def test_a_scan_scores_the_same_through_both_layouts(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = scored(capsys, place, "mvsnet", "--masks", place / "masks")
    other = scored(capsys, place, "idr")
    assert (one["protocol"]["layout"], other["protocol"]["layout"]) == ("MVSNet's", "IDR's")
    assert one["protocol"]["mask_rule"] == other["protocol"]["mask_rule"] == "object mask"
    assert {view["view"] for view in one["views"]} == {"holdout-0000", "holdout-0004"}
    assert one["metrics"].keys() == other["metrics"].keys()
    for name, value in one["metrics"].items():
        assert other["metrics"][name] == pytest.approx(value, rel=1e-9), name
    assert 10 < one["metrics"]["psnr_masked"] < 60
    first = json.loads((place / "scene" / "run.json").read_text())["metrics"]["first_frames"]
    assert [(kept["camera"], kept["stamp_ns"]) for kept in first] == [("camera", 1)]
    assert one["recording"]["differences"] == other["recording"]["differences"] == []


def test_without_depth_colours_are_scored_and_nothing_counts_as_seen(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = scored(capsys, place, "blind")
    assert result["metrics"]["psnr_seen"] is None
    assert result["metrics"]["depth_median_all"] is None
    with_depth = scored(capsys, place, "idr")["metrics"]
    for name in ("psnr_masked", "psnr_all", "ssim_published"):
        assert result["metrics"][name] == pytest.approx(with_depth[name], abs=1e-9)


def test_a_scan_without_depth_is_not_reconstructed_without_points(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reconstruct", "--dtu", str(place / "blind"), "-o", str(tmp_path / "scene"), *QUICK]) == 4
    assert "has no depth; give --depths DIR, or --points FILE.ply instead" in capsys.readouterr().err
    depths = ["--depths", str(place / "mvsnet" / "Depths_raw" / "scan1")]
    assert main(["reconstruct", "--dtu", str(place / "blind"), *depths, "-o", str(tmp_path / "scene"), *QUICK]) == 0


def test_the_report_says_by_what_its_figures_came_about(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(place, "idr", "--protocol", HOLDOUT) == 0
    out = capsys.readouterr().out
    assert "\nprotocol: holdout:every4 (a rule given by hand)\n" in out
    assert "\nsplit: train 1-3, 5-7; score 0, 4\n" in out
    assert "mask rule: object mask; averaging: mean over the views; resolution: 128x104; backgr" in out
    assert "dB mask" in out
    assert "dB mask" in out.splitlines()[2]
    result = scored(capsys, place, "idr")
    assert " ".join(result) == (
        "exit_code verdict scene reference cameras training_cameras has_clock snapshots recording protocol metrics"
        " warnings skipped_views views"
    )
    protocol = result["protocol"]
    assert " ".join(protocol) == (
        "name source layout training_views scored_views left_out_views split mask_rule resolution"
        " published_resolution published_scans background averaging lpips definitions"
    )
    assert (protocol["training_views"], protocol["scored_views"]) == ([1, 2, 3, 5, 6, 7], [0, 4])
    assert len(protocol["background"]) == 3


def test_a_scene_of_another_split_is_refused_with_the_views(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(place, "mvsnet", "--protocol", "dtu-train") == 2
    said = capsys.readouterr().err
    assert "protocol dtu-train trains on 8 views (train 0-7; score 0-7), of which 2 did not train the scene" in said
    assert "and 0 others did; reconstruct with --protocol dtu-train" in said
    assert run(place, "mvsnet", "--protocol", "holdout:2,6") == 2
    assert "of which 2 did not train the scene, and 2 others did" in capsys.readouterr().err


def test_a_protocol_whose_views_the_scan_lacks_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(place, "mvsnet", "--protocol", "regnerf-3") == 4
    assert "the scan has views 0-7; give a protocol for it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--protocol", HOLDOUT, "--holdout", "1"], "--holdout: the protocol says what is held out"),
        (["--protocol", "regnerf"], "did you mean regnerf-"),
        (["--images", "all"], "--images all: expected a folder for them; give -o"),
        (["--seed", "3"], "--seed: only with --fit"),
        (["--fit-iterations", "3"], "--fit-iterations: only with --fit"),
        (["--cloud-unit", "1"], "--cloud-unit: only with --cloud"),
        (["--cloud", "a.ply", "--cloud-max", "0"], "argument --cloud-max: expected 1e-06 to 1000 m, got '0'"),
    ],
)
def test_bad_usage_names_the_thing(
    place: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert run(place, "mvsnet", *arguments) == 2
    assert message in capsys.readouterr().err


def test_images_in_a_folder_are_told_from_logs_and_captures(tmp_path: Path) -> None:
    for name, content in (("views/transforms.json", "{}"), ("capture/capture.json", "{}"), ("bag/metadata.yaml", "")):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(content)
    names = ("views", "capture", "bag", "log.mcap", "views.toml")
    assert [is_folder_of_views(tmp_path / name) for name in names] == [True, False, False, False, True]


def test_pictures_of_every_view_of_the_extremes_or_none(place: Path, tmp_path: Path) -> None:
    def names(images: str) -> set[str]:
        out = tmp_path / images
        assert run(place, "mvsnet", "--protocol", HOLDOUT, "--images", images, "-q", "-o", out) == 0
        return {str(path.relative_to(out)) for path in out.rglob("*.png")}

    assert names("all") == {"views/holdout-0000.png", "views/holdout-0004.png", "holdout_best_worst.png"}
    assert names("best-worst") == {"holdout_best_worst.png"}
    assert names("none") == set()


def test_warnings_are_printed_counted_and_can_be_gated(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (place / "masks").iterdir():
        cv2.imwrite(str(tmp_path / path.name), 255 - cv2.imread(str(path)))  # type: ignore[operator]
    arguments = ("--protocol", HOLDOUT, "--masks", tmp_path, "--require", "num_warnings<=0")
    assert run(place, "mvsnet", *arguments) == 1
    said = capsys.readouterr()
    assert "\n  note: score: holdout-0000 has its mask on 100% of the image's border" in said.out
    assert "num_warnings is 1, required <= 0" in said.err
    assert scored(capsys, place, "mvsnet", "--require", "num_warnings<=0")["warnings"] == []


def test_figures_are_compared_with_those_of_an_earlier_score(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--protocol", HOLDOUT, "-q")
    assert run(place, "mvsnet", *given, "--images", "none", "-o", tmp_path / "out") == 0
    path = tmp_path / "out" / "score.json"
    earlier = json.loads(path.read_text())
    earlier["metrics"]["psnr_all"] += 1.5
    path.write_text(json.dumps(earlier))
    gate = ("--baseline", path, "--require", "change_psnr_all>=-1", "--require", "change_ssim_all>=0")
    capsys.readouterr()
    assert run(place, "mvsnet", *given, *gate) == 1
    said = capsys.readouterr()
    assert said.err.startswith(
        "splatctrl: score: GATE FAILED (2 views): --require change_psnr_all>=-1: change_psnr_all"
    )
    assert said.err.endswith(" is -1.5, required >= -1\n")
    (change,) = [line.split() for line in said.out.splitlines() if line.startswith("change")]
    assert change[1:6] == ["-", "+0.00", "-1.50", "+0.0000", "+0.0000"]
    assert run(place, "mvsnet", *given, *gate[2:]) == 2
    assert "change_psnr_all>=-1: a figure of --baseline; give it" in capsys.readouterr().err
    assert run(place, "mvsnet", *given, "--masks", place / "masks", "--baseline", path) == 4
    assert "not comparable: mask_rule: expected object mask, got none; score the base" in capsys.readouterr().err
    assert run(place, "mvsnet", *given, "--baseline", tmp_path / "out" / "run.json") == 4
    assert "run.json: expected the score.json of an earlier score" in capsys.readouterr().err


def test_views_that_are_missing_are_named(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dtu(tmp_path / "dtu", "scan1", views)
    (tmp_path / "dtu/Depths_raw/scan1/depth_map_0004.pfm").unlink()
    scene = ["score", str(place / "scene"), "--dtu", str(tmp_path / "dtu"), "--protocol"]
    assert main([*scene, "holdout:every5", "-q"]) == 2
    assert "of which 0 did not train the scene, and 1 others did" in capsys.readouterr().err
    assert main([*scene, "holdout:0,4", "-q"]) == 4
    assert "got no view 4; the scan has views 0-3, 5-7" in capsys.readouterr().err
    reference = DtuSource(tmp_path / "dtu", protocol=score_protocol("holdout:every5"))
    first, second = missing_views(reference, score_protocol("holdout:every5"))
    assert first.startswith("dtu/scan1: views 4 are not there: 'holdout:every5' counts those that are, and scores")
    assert second == "rect_005_3_r5000.png: without depth, left out"
    assert missing_views(DtuSource(place / "mvsnet"), score_protocol("holdout:every5")) == []


def surface(views: list[DtuView]) -> Float64:
    """What the views' depth measured [m], world."""
    parts = []
    for view in views:
        k, (v, u) = view.intrinsics, np.mgrid[: view.intrinsics.height : 2, : view.intrinsics.width : 2]
        z = view.depth[::2, ::2].astype(np.float64)
        points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=-1)[z > 0]
        parts.append(points @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3])
    return np.concatenate(parts)


def write_cloud(path: Path, points: Float64) -> Path:
    rows = "\n".join(" ".join(f"{value:.6f}" for value in point) for point in points)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    properties = "".join(f"property float {name}\n" for name in "xyz")
    path.write_text(f"{header}{properties}end_header\n{rows}\n", encoding="ascii")
    return path


def test_the_surface_is_compared_with_a_cloud_in_millimetres(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = write_cloud(tmp_path / "cloud.ply", 1000 * surface(views[:3]))
    given = ("--cloud", cloud, "--cloud-spacing", "0.004", "--require", "chamfer<=0.02", "--require", "accuracy>0")
    metrics = scored(capsys, place, "mvsnet", *given)["metrics"]
    assert 0.0005 < metrics["accuracy"] < 0.012
    assert 0.0005 < metrics["completeness"] < 0.012
    assert metrics["chamfer"] == pytest.approx((metrics["accuracy"] + metrics["completeness"]) / 2)
    assert metrics["completeness_seen_beyond"] < metrics["completeness_beyond"] + 1e-9
    assert run(place, "mvsnet", "--protocol", HOLDOUT, "--cloud", cloud, "--cloud-spacing", "0.004") == 0
    out = capsys.readouterr().out
    assert "surface: accuracy " in out
    assert "1 unit = 0.001 m; points 4 mm apart; means below 20 mm" in out
    blind = scored(capsys, place, "blind", *given)["metrics"]
    assert blind["accuracy"] == pytest.approx(metrics["accuracy"], rel=1e-3), "the surface is rendered, not recorded"
    moved = scored(capsys, place, "mvsnet", *given[:4], "--cloud-max", "0.004")["metrics"]
    assert moved["accuracy"] < metrics["accuracy"]
    assert moved["accuracy_beyond"] > metrics["accuracy_beyond"]


def test_the_surface_is_compared_where_dtus_own_evaluation_looks(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = surface(views[:3])
    write_cloud(tmp_path / "stl001_total.ply", 1000 * points)
    middle = 1000 * np.median(points, axis=0)
    middle[2] = 30.0  # above the table
    write_observed(tmp_path, 1, middle - 100, middle + 100)
    given = ("--cloud", tmp_path, "--cloud-spacing", "0.004")
    whole = scored(capsys, place, "mvsnet", *given)["metrics"]
    result = scored(capsys, place, "mvsnet", *given, "--cloud-masks", tmp_path)
    assert 100 < result["metrics"]["num_points"] < 0.5 * whole["num_points"]
    above = spaced(points, 0.004)[:, 2] > 0.03
    assert result["metrics"]["num_reference"] == pytest.approx(np.count_nonzero(above), rel=0.05)
    assert "within the masks and above the planes of" in result["protocol"]["definitions"]["cloud"]
    assert run(place, "mvsnet", "--protocol", HOLDOUT, "--cloud", tmp_path / "masks.ply") == 4
    assert run(place, "mvsnet", "--protocol", HOLDOUT, *given, "--cloud-masks", place) == 4
    assert "ObsMask1_10.mat: no such file; give the folder ObsMask" in capsys.readouterr().err


def test_the_surface_is_compared_with_a_mesh(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    middle = np.median(surface(views), axis=0)
    corners = middle + 0.1 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = tmp_path / "plane.obj"
    mesh.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\nf 1 3 4\n", encoding="ascii")
    given = ("--cloud", mesh, "--cloud-unit", "1", "--cloud-spacing", "0.005", "--cloud-max", "0.1")
    metrics = scored(capsys, place, "mvsnet", *given)["metrics"]
    assert metrics["num_reference"] == pytest.approx(0.55 * 0.04 / 0.005**2, rel=0.1), "a spacing apart"
    assert 0 < metrics["completeness"] < 0.1


def test_a_cloud_in_another_unit_is_refused_with_both_boxes(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = write_cloud(tmp_path / "cloud.ply", 1000 * surface(views[:1]))
    arguments = ("--protocol", HOLDOUT, "--cloud", cloud, "--cloud-spacing", "0.01", "--cloud-unit", "1")
    assert run(place, "mvsnet", *arguments) == 5
    assert "give the cloud's unit as --cloud-unit" in capsys.readouterr().err


def test_a_gate_on_what_was_not_scored_fails(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(place, "mvsnet", "--protocol", HOLDOUT, "--require", "psnr_masked>=1", "--require", "lpips<=1") == 5
    said = capsys.readouterr().err
    assert "score: NOT EVALUABLE (2 views): --require psnr_masked>=1: psnr_masked is unknown, required >= 1" in said
    assert "lpips is unknown, required <= 1" in said


def test_another_scan_of_the_same_camera_names_is_refused_with_figures(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shift = np.eye(4)
    shift[0, 3] = 0.02
    moved = [replace(v, T_world_camera=shift @ v.T_world_camera) for v in views]
    write_dtu(tmp_path / "other", "scan1", moved)
    arguments = ["score", str(place / "scene"), "--dtu", str(tmp_path / "other"), "--protocol", HOLDOUT]
    assert main(arguments) == 4
    said = capsys.readouterr().err
    assert (
        f"not the recording that {place / 'scene'} was made from: 8 of 32 files have other contents, such as" in said
    )
    assert "; camera: the pose differs by 20 mm and 0.0 degrees; give that recording, or --allow-other-rec" in said


def test_another_recording_may_be_scored_and_is_named(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dark = [replace(view, color=view.color // 2) for view in views]
    write_dtu(tmp_path / "other", "scan1", dark)
    arguments = ["score", str(place / "scene"), "--dtu", str(tmp_path / "other"), "--protocol", HOLDOUT]
    assert main(arguments) == 4
    assert "camera: the picture differs by up to " in capsys.readouterr().err
    assert main([*arguments, "--allow-other-recording"]) == 0
    assert "note: score: another recording: camera: the picture differs by up to" in capsys.readouterr().out


def test_a_scene_without_first_frames_is_told_by_the_digests_of_its_files(
    place: Path, views: list[DtuView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    shutil.copytree(place / "scene", tmp_path / "scene")
    path = tmp_path / "scene" / "run.json"
    old = json.loads(path.read_text())
    del old["metrics"]["first_frames"]
    path.write_text(json.dumps(old))
    arguments = ["score", str(tmp_path / "scene"), "--protocol", HOLDOUT, "--json", "--dtu"]
    assert main([*arguments, str(place / "mvsnet")]) == 0
    basis = json.loads(capsys.readouterr().out)["recording"]["basis"]
    assert basis == ["digests of 32 files of the same names"]
    write_dtu(tmp_path / "other", "scan1", [replace(view, color=view.color // 2) for view in views])
    assert main([*arguments, str(tmp_path / "other")]) == 4
    assert (
        "8 of 32 files have other contents, such as Rectified/scan1_train/rect_001_3_r5000.png"
        in capsys.readouterr().err
    )
