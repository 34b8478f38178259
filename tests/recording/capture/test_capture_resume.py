"""An interrupted `ingest` goes on to the same bytes, and a frame of a capture is read alone."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.recording.capture.capture_writer import JOURNAL, write_capture
from splatctrl_cli.recording.log import ros_log
from splatctrl_cli.recording.log.stored_frame import StoredFrame
from splatctrl_cli.recording.source import describe, open_source
from tests.recording.log.make_log import LogRecipe, make_log


def contents(folder: Path) -> dict[str, bytes]:
    files = [p for p in folder.rglob("*") if p.is_file() and p.name != "run.json"]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def interrupted(log: Path, out: Path, monkeypatch: pytest.MonkeyPatch, after: int) -> Path:
    """The partial folder of an ingest that was stopped after some frames."""
    frames = ros_log.RosLogSource._frames

    def stopping(self: ros_log.RosLogSource, *, lazily: bool = True) -> Iterator[StoredFrame]:
        for number, stored in enumerate(frames(self, lazily=lazily)):
            if number == after:
                raise KeyboardInterrupt
            yield stored

    with monkeypatch.context() as patch:
        patch.setattr(ros_log.RosLogSource, "_frames", stopping)
        assert main(["ingest", str(log), "-o", str(out), "-q"]) == 130
    assert not out.exists()
    return out.with_name(out.name + ".partial")


@pytest.mark.parametrize("after", [1, 3])
def test_an_interrupted_ingest_goes_on_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], after: int
) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(cameras=("cam0", "cam1")))
    assert main(["ingest", str(log), "-o", str(tmp_path / "whole"), "-q"]) == 0
    out = tmp_path / "x.capture"
    partial = interrupted(log, out, monkeypatch, after)
    words = f"is kept; continue it with: splatctrl ingest --resume {log} -o {out} -q\n"
    assert words in capsys.readouterr().err
    images = sorted(partial.rglob("*.jpg"))
    assert len(images) == after
    written = images[0].stat().st_mtime_ns
    (partial / "color" / "cam1").mkdir(exist_ok=True)
    (partial / "color" / "cam1" / "000004.jpg").write_bytes(b"half")  # killed while it was written
    with (partial / JOURNAL).open("a") as stream:
        stream.write('{"row": {"camera"')
    assert main(["ingest", str(log), "-o", str(out), "-q", "--resume"]) == 0
    assert contents(out) == contents(tmp_path / "whole")
    assert not partial.exists()
    assert (out / images[0].relative_to(partial)).stat().st_mtime_ns == written  # it was not written again


def test_without_resume_an_interrupted_ingest_starts_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, out = make_log(tmp_path / "log.mcap"), tmp_path / "x.capture"
    partial = interrupted(log, out, monkeypatch, 2)
    (partial / "color/cam0/000000.jpg").write_bytes(b"wrong")
    assert main(["ingest", str(log), "-o", str(out), "-q"]) == 0
    assert open_source(out).loss.damaged == 0
    assert len(list(open_source(out).records())) == 10


def test_going_on_with_other_options_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = make_log(tmp_path / "log.mcap"), tmp_path / "x.capture"
    partial = interrupted(log, out, monkeypatch, 2)
    again = ["ingest", str(log), "-o", str(out), "-q", "--resume"]
    assert main([*again, "--depth-scale", "0.002"]) == 2
    assert "options.depth_scale was not given, is 0.002" in capsys.readouterr().err
    assert partial.exists()
    make_log(log, LogRecipe(num_frames=4))
    assert main(again) == 2
    assert "sha256 of log.mcap" in capsys.readouterr().err


def test_frames_that_are_not_the_sources_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    partial = interrupted(make_log(tmp_path / "log.mcap"), tmp_path / "x.capture", monkeypatch, 2)
    moved = open_source(make_log(tmp_path / "moved.mcap", LogRecipe(tf_delay_ns=5_000_000)))
    with pytest.raises(UsageError, match=r"color/cam0/000001\.jpg: tx was 0\.1, is "):
        write_capture(partial, moved)


def test_what_an_interrupted_ingest_left_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = make_log(tmp_path / "log.mcap")
    partial = interrupted(log, tmp_path / "x.capture", monkeypatch, 2)
    with pytest.raises(
        InputError, match="an ingest that was interrupted; continue it with the same command and --resume"
    ):
        open_source(partial)
    with pytest.raises(InputError, match="an ingest that was interrupted"):
        describe(partial)
