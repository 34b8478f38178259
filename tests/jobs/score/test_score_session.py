"""`score` on a camera that another log of the same session holds than the one that made the scene."""

from collections.abc import Callable
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest
from splatctrl_cli.jobs.recordings.provenance import first_frame
from splatctrl_cli.jobs.score import score as score_job
from splatctrl_cli.jobs.score.score import ScoreRequest, ScoreResult, score
from splatctrl_cli.recording.container.raw_log import RawMessage
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import RgbdFrame
from tests.jobs.score.wall import FakeScene, FakeSnapshot, wall
from tests.recording.log.make_log import FRAME_NS, START_NS, LogRecipe, make_log, messages_of, write_raw

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


def run(folder: Path, *names: str) -> ScoreResult:
    first, *beside = (folder / name for name in names)
    recording = RecordingRequest(path=first, beside=tuple(beside))
    return score(ScoreRequest(scene=folder / "scene", recording=recording, images="none"))


def test_a_camera_of_another_log_is_scored_beside_the_log_that_trained(session: Path) -> None:
    report = run(session, "a.mcap", "b.mcap").report
    assert report["cameras"] == ["cam1"] and report["metrics"]["num_views"] == 5
    assert report["metrics"]["seen_share"] > 0.99, "both cameras stand at one place"
    assert report["reference"] == f"{session / 'a.mcap'} + {session / 'b.mcap'}"


def test_several_references_are_one_session(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [word for name in "ab" for word in ("--reference", str(session / f"{name}.mcap"))]
    assert main(["score", str(session / "scene"), *logs]) == 0
    assert "5 views scored" in capsys.readouterr().out


def test_the_other_log_alone_asks_for_the_one_that_trained(session: Path) -> None:
    whole = make_log(session / "whole.mcap", LogRecipe(cameras=("cam0", "cam1")))
    write_raw(session / "alone.mcap", filter(of("cam1", "tf"), messages_of(whole)))
    with pytest.raises(
        InputError, match=r"has no camera cam0; give that recording, .* give both, each as --reference"
    ):
        run(session, "alone.mcap")


def test_a_camera_that_no_transform_joins_to_the_world_is_refused_by_name(session: Path) -> None:
    alone = make_log(session / "apart.mcap", LogRecipe(cameras=("cam2",), has_tf=False))
    with pytest.raises(InputError, match=r"camera cam2: no tf for frame 'cam2_optical'"):
        run(session, "a.mcap", alone.name)


def test_a_camera_of_another_time_is_refused_by_name(session: Path) -> None:
    path = make_log(session / "late.mcap", LogRecipe(cameras=("cam1",), num_frames=40, tf_frames=40))
    late = [m for m in messages_of(path) if m.log_time_ns > START_NS + 10 * FRAME_NS or "static" in m.topic.name]
    write_raw(path, late)
    with pytest.raises(InputError) as refused:
        run(session, "a.mcap", path.name)
    line = (
        f"camera cam1: expected frames between those that trained, {START_NS} to {START_NS + 4 * FRAME_NS} ns, got"
        f" {START_NS + 11 * FRAME_NS} to {START_NS + 39 * FRAME_NS} ns; give logs of the same time and clock"
    )
    assert line in str(refused.value)


def test_a_log_beside_an_image_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"views.toml: expected a log beside others, got images in a folder"):
        RecordingRequest(path=tmp_path / "views.toml", beside=(tmp_path / "b.mcap",))
