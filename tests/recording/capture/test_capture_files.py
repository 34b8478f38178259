"""capture.json, frames.csv and SHA256SUMS of any program are read only where they say what a capture needs, the joint
topics that it keeps only where they are whole; and an interrupted `ingest` goes on to the same bytes.
"""

import hashlib
import json
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.recording.capture.capture_header import COLUMNS, FileSums, FrameRows, check_header
from splatctrl_cli.recording.capture.capture_writer import JOURNAL, write_capture
from splatctrl_cli.recording.log import ros_log
from splatctrl_cli.recording.log.ros_log import RosLogSource
from splatctrl_cli.recording.log.stored_frame import StoredFrame
from splatctrl_cli.recording.source import describe, open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from tests.recording.log.make_log import LogRecipe, make_log

CAMERA = {"width": 8, "height": 6, "fx": 9.0, "fy": 9, "cx": 3.5, "cy": 2.5, "depth_scale": 0.001}
HEADER: dict[str, Any] = {
    **{"world_frame": "world", "has_clock": True, "joint_names": ["a"], "cameras": {"cam": CAMERA}},
    **{"loss": {"damaged": 1, "notes": ["x"]}, "sources": {}, "name": "x"},
}


def test_what_is_right_passes() -> None:
    check_header(Path("capture.json"), HEADER)
    check_header(Path("capture.json"), HEADER | {"cameras": {"cam": CAMERA | {"depth_scale": None}}})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("world_frame", 3), ("has_clock", "yes"), ("joint_names", "ab"), ("joint_names", [1]), ("sources", [])),
        *(("loss", {"odd": 1}), ("loss", {"notes": "x"}), ("loss", []), ("loss", {"damaged": "1"}), ("cameras", [])),
        *(("cameras", {"cam": {**CAMERA, key: value}}) for key in CAMERA for value in ("1", -1, 1e400, True, [])
          if not (key in {"cx", "cy"} and value == -1) and not (key in {"width", "height"} and value is True)),
        *(("cameras", {"cam": {k: v for k, v in CAMERA.items() if k != key}}) for key in list(CAMERA)[:-1]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(name: str, value: object) -> None:
    with pytest.raises(InputError, match=rf"^x/capture.json: {name}: expected"):
        check_header(Path("x/capture.json"), HEADER | {name: value})
    with pytest.raises(InputError, match=rf"^x/capture.json: {name} is missing"):
        check_header(Path("x/capture.json"), {key: entry for key, entry in HEADER.items() if key != name})


HEAD = ",".join(COLUMNS) + "\n"


def line(camera: str, number: int, source: str = "a b") -> str:
    return f"{camera},{number},color/{camera}/{number}.jpg,depth/{camera}/{number}.png,0,0,0,0,0,0,1,{source}\n"


def frames(folder: Path, *lines: str, head: str = HEAD) -> Path:
    path = folder / "frames.csv"
    path.write_bytes((head + "".join(lines)).encode())
    return path


def test_rows_are_those_of_the_cameras(tmp_path: Path) -> None:
    lines = [line("a", 0), "\n", line("b", 1), line("a", 2, '"two\nlines, é"'), line("a", 3).rstrip("\n")]
    rows = list(FrameRows(frames(tmp_path, *lines), ("a",)))
    assert [row["stamp_ns"] for row in rows] == ["0", "2", "3"]
    assert rows[1]["source"] == "two\nlines, é" and rows[2]["depth"] == "depth/a/3.png"
    assert rows[0]["camera"] == "a"


OTHER = r"expected columns camera, stamp_ns, .*"


@pytest.mark.parametrize(
    ("head", "lines", "said"),
    [
        (HEAD, (line("a", 0), "a,1,b\n"), ""),
        (HEAD, (line("a", 0).replace("a,0,", "a,x,"),), ""),
        (HEAD, (line("a", 0).replace(",0,0,0,0", ",0,?,0,0"),), ""),
        (HEAD, (line("a", 0).replace("color/a", "color/../../a"),), ""),
        (HEAD, (line("a", 0).replace("depth/a", "/depth/a"),), ""),
        (HEAD, ("a" * (1 << 17),), ""),
        (HEAD, ("\xff\x00".encode("latin-1").decode("latin-1") + '"',), ""),
        (HEAD.replace("qw", "w"), (), OTHER),
        ("", (), OTHER),
    ],
)
def test_other_columns_and_what_is_no_row_are_refused(
    tmp_path: Path, head: str, lines: tuple[str, ...], said: str
) -> None:
    with pytest.raises(InputError, match=rf"frames.csv: {said}.*; run `splatctrl ingest` again"):
        FrameRows(frames(tmp_path, *lines, head=head), ("a",))


def test_sums_are_found_by_name_and_the_last_line_of_a_name_holds(tmp_path: Path) -> None:
    digests = {f"color/é{i}.jpg": hashlib.sha256(bytes([i])).hexdigest() for i in range(200)}
    lines = [f"{digest}  {name}\n" for name, digest in reversed(digests.items())]
    odd = ["no line\n", f"{'0' * 64}  color/é7.jpg\n", "zz" * 32 + "  color/é8.jpg\n", "\n"]
    (tmp_path / "SHA256SUMS").write_text("".join([*odd[:2], *lines, *odd[2:]]), encoding="utf-8")
    sums = FileSums(tmp_path)
    assert {name: sums.get(name) for name in digests} == digests
    assert sums.get("color/é200.jpg") is None and sums.get("") is None
    (tmp_path / "SHA256SUMS").write_text("")
    assert FileSums(tmp_path).get("a") is None
    with pytest.raises(InputError, match="missing; the capture was not finished"):
        FileSums(tmp_path / "none")


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


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    source = open_source(make_log(tmp_path / "log.mcap", LogRecipe(num_frames=3)))
    assert isinstance(source, RosLogSource)
    folder = tmp_path / "x.capture"
    folder.mkdir()
    write_capture(folder, source, topics=source.joint_topics)
    return folder


def replace_file(capture: Path, name: str, data: bytes) -> None:
    """Another file of that name, with the right checksum."""
    (capture / name).write_bytes(data)
    lines = (capture / "SHA256SUMS").read_text().splitlines()
    lines = [line for line in lines if line[66:] != name] + [f"{sha256(data).hexdigest()}  {name}"]
    (capture / "SHA256SUMS").write_text("\n".join(lines) + "\n")


def read(capture: Path) -> int:
    names = open_source(capture).joint_names
    return sum(1 for _ in open_states(capture, SourceOptions(), names).records())


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((2, 2)),
        np.zeros((3, 2), np.float32),
        np.asfortranarray(np.zeros((9, 2))),
        np.array(1.0),
        np.array([{}], dtype=object),
    ],
)
def test_other_rows_than_those_of_the_stamps_are_refused(capture: Path, tmp_path: Path, array: np.ndarray) -> None:
    assert read(capture) > 0
    np.save(tmp_path / "x.npy", array)
    replace_file(capture, "joint_topics/0/position.npy", (tmp_path / "x.npy").read_bytes())
    with pytest.raises(InputError, match="joint_topics: cannot be read"):
        read(capture)


@pytest.mark.parametrize("at", [0, 70, -8])
def test_a_file_that_does_not_hold_what_it_announces_is_refused(capture: Path, at: int) -> None:
    name = "joint_topics/0/position.npy"
    replace_file(capture, name, (capture / name).read_bytes()[:at])
    with pytest.raises(InputError, match="joint_topics: cannot be read"):
        read(capture)


@pytest.mark.parametrize("place", ["..", "/tmp", "joint_topics/../.."])
def test_a_folder_outside_the_capture_is_refused(capture: Path, place: str) -> None:
    header = json.loads((capture / "capture.json").read_text())
    header["joint_topics"]["topics"][0]["streams"][0]["folder"] = place
    replace_file(capture, "capture.json", json.dumps(header).encode())
    with pytest.raises(InputError, match="lies outside the capture"):
        read(capture)
