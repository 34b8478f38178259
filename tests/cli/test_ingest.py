"""``splatctrl ingest``, ``info`` and ``check`` as a person meets them: exit codes, one line, nothing left."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.checks.finding import CHECKS
from splatctrl_cli.cli.main import main
from splatctrl_cli.recording.source import open_source
from tests.recording.folder.test_image_folder import described
from tests.recording.log.make_log import (
    STORE,
    LogRecipe,
    Message,
    broken_log,
    encoded,
    header,
    make_log,
    messages_of,
    write_raw,
)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


def run_json(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any], str]:
    """Exit code, JSON object and stderr of a command."""
    code, printed, said = run(capsys, *arguments, "--json")
    return code, json.loads(printed), said


def test_ingest_writes_a_capture_that_reads_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spaces around names do not count; frames without a pose are counted."""
    log, out = (
        make_log(tmp_path / "log.mcap", LogRecipe(cameras=("cam0", "cam1"), tf_frames=3)),
        tmp_path / "x.capture",
    )
    code, result, _ = run_json(capsys, "ingest", log, "--cameras", " cam1, cam0,", "-o", out)
    assert (code, result["frames"], result["joint_states"]) == (0, {"cam0": 3, "cam1": 3}, 5)
    assert len(list(open_source(out).records())) == 11
    assert json.loads((out / "run.json").read_text())["inputs"].keys() == {"log.mcap"}
    assert not (tmp_path / "x.capture.partial").exists()
    assert "without pose: 4" in run(capsys, "ingest", log, "-o", out, "--force")[1]


def test_a_truncated_log_is_exit_3_with_what_precedes_the_cut(
    logs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, result, _ = run_json(capsys, "ingest", logs["cut"], "-o", tmp_path / "x.capture")
    assert (code, result["loss"]["damaged"]) == (3, 1)
    assert (tmp_path / "x.capture" / "capture.json").is_file()
    assert run(capsys, "info", logs["cut"])[0] == 3


def test_topics_and_pose_can_be_given_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out = make_log(tmp_path / "log.mcap", LogRecipe(has_tf=False)), tmp_path / "x.capture"
    topics = "eye=/cam0/color/image_raw/compressed,/cam0/depth/image_raw,/cam0/color/camera_info"
    assert run(capsys, "ingest", log, "-o", out, "--camera", topics, "--camera-pose", "eye=0.5,0,1,0,0,0,1")[0] == 0
    assert open_source(out).cameras == ("eye",)


def test_a_capture_without_a_camera_to_train_with_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views, out = described(tmp_path, "[split]\nholdout = [7]\n"), tmp_path / "x.capture"
    said = "splatctrl: --cameras holdout: leaves no camera to train with; name another, or leave it out\n"
    assert run(capsys, "ingest", views, "--cameras", "holdout", "-o", out) == (2, "", said) and not out.exists()


def test_info_says_for_people_and_in_json_what_is_there_and_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(has_depth=False))
    code, printed, _ = run(capsys, "info", log)
    assert code == 0
    assert "missing for a reconstruction: no depth topic" in printed and "/joint_states" in printed
    code, result, _ = run_json(capsys, "info", log)
    assert result["kind"] == "MCAP" and result["missing"][0].startswith("no depth topic")
    assert {row["topic"] for row in result["topics"]} >= {"/tf", "/joint_states"}


def test_info_keeps_names_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = {"command": "x", "inputs": {"robot_spheres.yaml": "12ab"}, "config": {"max_splats": 5}, "stamp_ns": None}
    (tmp_path / "run.json").write_text(json.dumps(given))
    code, printed, _ = run(capsys, "info", tmp_path / "run.json")
    assert code == 0
    assert "\n    robot_spheres.yaml: 12ab\n" in printed and "\n    max_splats: 5\n" in printed
    assert "\n  stamp_ns: -\n" in printed


GOOD = LogRecipe(num_frames=20)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A good log, one whose poses end early, one whose depth is in metres, and one that was cut."""
    folder = tmp_path_factory.mktemp("logs")
    recipes = {
        "good": GOOD,
        "poses": replace(GOOD, tf_frames=12),
        "depth": replace(GOOD, depth_counts=1),
        "cut": GOOD,
    }
    found = {name: make_log(folder / f"{name}.mcap", recipe) for name, recipe in recipes.items()}
    found["cut"].write_bytes(found["cut"].read_bytes()[: found["cut"].stat().st_size // 3])
    return found


LEFT_OUT = r".*, part of the recording is damaged and left out \(cut\.mcap: "


@pytest.mark.parametrize(
    ("log", "fail_on", "code", "first"),
    [
        ("good", "warning", 0, r"check: PASSED \(good\.mcap: 0 errors, 0 warnings, \d+ notes?\)\n\n"),
        *(("poses", "error", 0, "check: PASSED"), ("poses", "warning", 1, "check: FAILED")),
        *(("poses", "never", 0, "check: PASSED"), ("depth", "error", 1, "check: FAILED")),
        *(("depth", "warning", 1, "check: FAILED"), ("depth", "never", 0, "check: FAILED")),
        *(("cut", "error", 3, f"check: PASSED{LEFT_OUT}"), ("cut", "warning", 1, f"check: FAILED{LEFT_OUT}")),
        ("cut", "never", 0, f"check: PASSED{LEFT_OUT}"),
    ],
)
def test_a_finding_fails_where_it_is_asked_to(
    logs: dict[str, Path], capsys: pytest.CaptureFixture[str], log: str, fail_on: str, code: int, first: str
) -> None:
    found, printed, error = run(capsys, "check", logs[log], "--fail-on", fail_on)
    assert (found, error) == (code, "") and re.match(first, printed), printed
    assert log != "good" or "can start: ingest, reconstruct, score, replay" in printed
    if log == "poses":
        assert "warning: camera cam0, at " in printed
        assert printed.count("[pose-missing]\n") == 1, "its table says it, and nothing else does"


@pytest.mark.parametrize(("fail_on", "code"), [("error", 1), ("never", 0)])
def test_an_error_is_an_object_of_which_stderr_has_the_sentence_where_it_fails(
    logs: dict[str, Path], capsys: pytest.CaptureFixture[str], fail_on: str, code: int
) -> None:
    found, result, said = run_json(capsys, "check", logs["depth"], "--fail-on", fail_on)
    assert said == (f"splatctrl: {result['verdict']['sentence']}\n" if code else "")
    assert (found, result["exit_code"], result["verdict"]["outcome"]) == (code, code, "failed")
    assert result["verdict"]["reasons"][0]["criterion"] == "depth-scale" and result["counts"]["error"] == 1
    finding = {name: result["findings"][0][name] for name in ("severity", "code", "where", "value")}
    assert [*finding.values()] == ["error", "depth-scale", "/cam0/depth/image_raw", pytest.approx(0.001)]
    assert all("depth-scale" in result["commands"][name][-1] for name in CHECKS["depth-scale"].blocked)


def test_cameras_whose_poses_disagree_are_an_error_with_millimetres(
    real_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    description = Path(__file__).parents[2] / "docs/examples/arc_bin_2cam.toml"
    code, result, _ = run_json(capsys, "check", description, "--root", real_data / "arc_bin_2cam")
    finding = {name: result["findings"][0][name] for name in ("code", "severity", "unit", "value")}
    assert (code, *finding.values()) == (1, "agreement", "error", "mm", pytest.approx(99, abs=3))


def test_a_camera_that_sees_a_wall_elsewhere_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def farther(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/cam1/depth/image_raw":
            counts = message.data.view("<u2")
            counts[counts > 0] += 100
        yield log_time, topic, kind, message

    log = broken_log(tmp_path / "log.mcap", farther, replace(GOOD, cameras=("cam0", "cam1")))
    code, result, _ = run_json(capsys, "check", log)
    finding = {name: result["findings"][0][name] for name in ("code", "where", "value")}
    assert (code, *finding.values()) == (1, "agreement", "cameras cam0 and cam1", pytest.approx(100))
    assert "poses are off, or too little depth is left" in result["findings"][0]["remedy"]
    assert "agreement" in result["commands"]["reconstruct"][0] and result["commands"]["ingest"] == []


@pytest.mark.parametrize(
    ("example", "folder"),
    [
        ("apc_shelf", "apc_shelf/scene-0000"),
        ("open3d_rgbd", "open3d_rgbd/RGBD"),
        ("livingroom1", "open3d_rgbd/livingroom1"),
        ("tabletop_views", "tabletop_views"),
    ],
)
def test_good_recordings_have_no_finding_above_a_note(
    real_data: Path, capsys: pytest.CaptureFixture[str], example: str, folder: str
) -> None:
    description = Path(__file__).parents[2] / f"docs/examples/{example}.toml"
    code, printed, _ = run(capsys, "check", description, "--root", real_data / folder, "--fail-on", "warning")
    assert code == 0, printed


def test_a_capture_is_checked_as_its_log(
    logs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = tmp_path / "x.capture"
    assert run(capsys, "ingest", logs["poses"], "-o", capture, "-q")[0] == 0
    code, result, _ = run_json(capsys, "check", capture, "--fail-on", "warning")
    assert (code, result["kind"]) == (1, "capture")
    assert [f["code"] for f in result["findings"] if f["severity"] != "note"] == ["pose-missing"]
    (capture / "depth/cam0/000003.png").write_bytes(b"")
    assert "depth/cam0/000003.png: its checksum differs" in run(capsys, "check", capture)[1]


@pytest.mark.parametrize(("num", "is_folded"), [(3, False), (4, True)])
def test_info_folds_topics_that_no_command_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], num: int, is_folded: bool
) -> None:
    """A camera's driver records dozens beside its images; what is read, and a pose, stays."""
    text = STORE.types["std_msgs/msg/String"]
    pose = STORE.types["geometry_msgs/msg/PoseStamped"]
    point, turn = STORE.types["geometry_msgs/msg/Point"], STORE.types["geometry_msgs/msg/Quaternion"]
    at = pose(header(1, "world"), STORE.types["geometry_msgs/msg/Pose"](point(0, 0, 0), turn(0, 0, 0, 1)))
    others = [encoded(1, f"/device/option_{k}", text(data="x"), STORE) for k in range(num)]
    good = messages_of(make_log(tmp_path / "good.mcap", GOOD))
    log = write_raw(tmp_path / "log.mcap", [encoded(1, "/tool_pose", at, STORE), *others, *good])
    code, printed, _ = run(capsys, "info", log)
    assert code == 0
    assert ("/device/option_0 " in printed) is not is_folded
    assert (f"and {num} topics that no command reads; -v prints them" in printed) is is_folded
    assert all(name in printed for name in ("/tool_pose", "/cam0/depth/", "/tf"))
    assert f"/device/option_{num - 1} " in run(capsys, "info", log, "-v")[1]
    topics = json.loads(run(capsys, "info", log, "--json")[1])["topics"]
    assert sum(row["topic"].startswith("/device/") for row in topics) == num
