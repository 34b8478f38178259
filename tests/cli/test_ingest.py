"""``splatctrl ingest`` and ``splatctrl info`` as a person meets them: exit codes, one line, nothing left behind."""

import json
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import build_parser, main
from splatctrl_cli.recording.source import open_source
from tests.recording.folder.test_image_folder import described
from tests.recording.log.make_log import LogRecipe, make_log


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_ingest_writes_a_capture_that_reads_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out = make_log(tmp_path / "log.mcap"), tmp_path / "x.capture"
    code, printed, _ = run(capsys, "ingest", log, "-o", out, "--json")
    assert code == 0
    result = json.loads(printed)
    assert result["frames"] == {"cam0": 5}
    assert result["joint_states"] == 5
    assert len(list(open_source(out).records())) == 10
    assert json.loads((out / "run.json").read_text())["inputs"].keys() == {"log.mcap"}
    assert not (tmp_path / "x.capture.partial").exists()


def test_spaces_around_names_do_not_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(cameras=("cam0", "cam1")))
    assert run(capsys, "ingest", log, "--cameras", "cam1, cam0", "-o", tmp_path / "x.capture")[0] == 0
    assert build_parser().parse_args(["ingest", "log", "--cameras", " cam1, cam0,"]).cameras == "cam1,cam0"


def test_a_capture_without_a_camera_to_train_with_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views, out = described(tmp_path, "[split]\nholdout = [7]\n"), tmp_path / "x.capture"
    code, _, error = run(capsys, "ingest", views, "--cameras", "holdout", "-o", out)
    assert code == 2
    assert error == "splatctrl: --cameras holdout: leaves no camera to train with; name another, or leave it out\n"
    assert not out.exists()


def test_a_truncated_log_is_exit_3_with_what_precedes_the_cut(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=20)), tmp_path / "x.capture"
    log.write_bytes(log.read_bytes()[: log.stat().st_size * 6 // 10])
    code, printed, _ = run(capsys, "ingest", log, "-o", out, "--json")
    assert code == 3
    assert json.loads(printed)["loss"]["damaged"] == 1
    assert (out / "capture.json").is_file()
    assert run(capsys, "info", log)[0] == 3


def test_frames_without_partner_or_pose_are_counted_and_exit_0(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(tf_frames=3))
    code, printed, _ = run(capsys, "ingest", log, "-o", tmp_path / "x.capture")
    assert code == 0
    assert "without pose: 2" in printed


def test_topics_and_pose_can_be_given_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out = make_log(tmp_path / "log.mcap", LogRecipe(has_tf=False)), tmp_path / "x.capture"
    topics = "eye=/cam0/color/image_raw/compressed,/cam0/depth/image_raw,/cam0/color/camera_info"
    pose = "eye=0.5,0,1,0,0,0,1"
    assert run(capsys, "ingest", log, "-o", out, "--camera", topics, "--camera-pose", pose)[0] == 0
    assert open_source(out).cameras == ("eye",)


def test_info_says_for_people_and_in_json_what_is_there_and_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(has_depth=False))
    code, printed, _ = run(capsys, "info", log)
    assert code == 0
    assert "missing for a reconstruction: no depth topic" in printed
    assert "/joint_states" in printed
    code, printed, _ = run(capsys, "info", log, "--json")
    result = json.loads(printed)
    assert result["kind"] == "MCAP"
    assert result["missing"][0].startswith("no depth topic")
    assert {row["topic"] for row in result["topics"]} >= {"/tf", "/joint_states"}


def test_info_keeps_names_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = {"command": "x", "inputs": {"robot_spheres.yaml": "12ab"}, "config": {"max_splats": 5}, "stamp_ns": None}
    (tmp_path / "run.json").write_text(json.dumps(given))
    code, printed, _ = run(capsys, "info", tmp_path / "run.json")
    assert code == 0
    assert "\n    robot_spheres.yaml: 12ab\n" in printed
    assert "\n    max_splats: 5\n" in printed
    assert "\n  stamp_ns: -\n" in printed
