"""A capture gives back what was put in, to the bit where it can, and notices damage, files that change meanwhile, and
names that lead elsewhere. Those of any program are read only where they say what a capture needs, and an interrupted
`ingest` goes on to the same bytes.
"""

import csv
import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import UsageError
from splatctrl_cli.recording.capture.capture import COLUMNS, FileSums, FrameRows, check_header
from splatctrl_cli.recording.capture.capture_writer import JOURNAL, write_capture
from splatctrl_cli.recording.container.mcap_file import CHUNK
from splatctrl_cli.recording.log.ros_log import RosLogSource
from splatctrl_cli.recording.log.stored_frame import StoredFrame
from splatctrl_cli.recording.source import SourceOptions, describe, open_source
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import JointState, Record
from tests.conftest import ROOT
from tests.recording.container.test_log_formats import as_ros2_folder, assert_same
from tests.recording.log.make_log import FRAME_NS, START_NS, LogRecipe, frames_of, make_log
from tests.refused import expect_refusal


def captured(tmp_path: Path, recipe: LogRecipe, options: SourceOptions | None = None) -> tuple[list[Record], Path]:
    source = open_source(make_log(tmp_path / "log.mcap", recipe), options)
    write_capture(
        tmp_path / "x.capture", source, topics=source.joint_topics if isinstance(source, RosLogSource) else ()
    )
    return list(source.records()), tmp_path / "x.capture"


MASKED = SourceOptions(human_topics={"cam0": "/cam0/people/mask"})

PINCUSHION = LogRecipe(color_format="png", distortion=(0.4, 0.0, 0.0, 0.0, 0.0))
WARPED = LogRecipe(depth_frame="cam0_depth", depth_size=(16, 12), depth_encoding="32FC1", depth_m=1.23457)


@pytest.mark.parametrize(
    "recipe",
    [
        *(LogRecipe(color_format=f, cameras=("cam0", "cam1")) for f in ("jpeg", "rgb8", "bgra8", "mono8")),
        LogRecipe(has_joints=False, mask_every=2, tf_frames=5, num_frames=7),
        WARPED,
        PINCUSHION,
    ],
)
def test_a_capture_gives_the_same_records(tmp_path: Path, recipe: LogRecipe) -> None:
    before, folder = captured(tmp_path, recipe, options=MASKED if recipe.mask_every else None)
    source = open_source(folder)
    assert_same(before, list(source.records()))
    assert (source.joint_names, source.has_clock) == (("joint_a", "joint_b") * recipe.has_joints, True)
    loss, frames = source.loss, frames_of(source)
    assert (loss.damaged, loss.without_pose) == (0, 2 if recipe.mask_every else 0), "the log's own is kept"
    if recipe.mask_every:
        assert [frame.human is not None for frame in frames] == [True, False, True, False, True]
    if recipe is PINCUSHION:  # what the lens did not see is stored once
        assert (frames[0].valid.all(), len(list((folder / "valid/cam0").iterdir()))) == (False, 1)


@pytest.mark.parametrize(("depth_m", "suffix", "most"), [(1.2345, "png", 1e-6), (1.23457, "npy", 0.0)])
def test_float_depth_on_a_grid_becomes_png_and_other_depth_stays_float(
    tmp_path: Path, depth_m: float, suffix: str, most: float
) -> None:
    _, folder = captured(tmp_path, LogRecipe(depth_encoding="32FC1", depth_m=depth_m))
    assert (folder / f"depth/cam0/000000.{suffix}").is_file()
    for kept, recorded in zip(frames_of(folder), frames_of(tmp_path / "log.mcap"), strict=True):
        assert np.abs(kept.depth - recorded.depth).max() <= most


def test_compressed_color_is_kept_byte_for_byte(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    stored = open_source(tmp_path / "log.mcap").stored()
    recorded = [item.color_file for item in stored if not isinstance(item, JointState)]
    assert [file.read_bytes() for file in sorted(folder.glob("color/cam0/*.jpg"))] == recorded


def test_every_file_stands_in_sha256sums_by_name(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, replace(PINCUSHION, cameras=("cam", "cam-b", "cam0")))  # with masks of the lens
    sums = [line.split("  ")[::-1] for line in (folder / "SHA256SUMS").read_text().splitlines()]
    files = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    del files["SHA256SUMS"]
    assert sums == [[name, sha256(files[name].read_bytes()).hexdigest()] for name in sorted(files)]


def test_a_damaged_image_is_left_out_and_counted(tmp_path: Path) -> None:
    before, folder = captured(tmp_path, LogRecipe())
    image = folder / "depth/cam0/000002.png"
    image.write_bytes(image.read_bytes()[:-4])
    (folder / "color/cam0/000004.jpg").unlink()
    source = open_source(folder)
    assert (len(list(source.records())), source.loss.damaged) == (len(before) - 2, 2)
    next(source.records())
    assert source.loss.damaged == 2, "a second pass that ends early forgets nothing"
    assert "depth/cam0/000002.png: its checksum differs" in source.loss.notes[0]
    assert "color/cam0/000004.jpg: missing" in source.loss.notes[1]


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_an_image_of_another_size_than_its_camera_is_left_out_and_counted(tmp_path: Path, kind: str) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    suffix = "jpg" if kind == "color" else "png"
    pixels = np.full((5, 6), 1250, np.uint16) if kind == "depth" else np.zeros((5, 6, 3), np.uint8)
    replace_file(folder, f"{kind}/cam0/000002.{suffix}", bytes(cv2.imencode(f".{suffix}", pixels)[1]))
    source = open_source(folder)
    assert (len(frames_of(source)), source.loss.damaged) == (4, 1)
    assert "expected images of 32x24 as capture.json says" in source.loss.notes[-1]


def test_options_that_a_capture_cannot_honour_and_newer_versions_are_refused(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    for change in ({"depth_scale": 1e-4}, {"world_frame": "base"}, {"holdout": ("0",)}, {"root": tmp_path}):
        expect_refusal("does not apply to a capture", open_source, folder, replace(SourceOptions(), **change))
    header = folder / "capture.json"
    header.write_text(header.read_text().replace('"version": 1', '"version": 99'))
    expect_refusal("expected version 1, got 99", open_source, folder)


@pytest.mark.parametrize(
    ("example", "folder"),
    [
        ("open3d_rgbd", "open3d_rgbd/RGBD"),
        ("tabletop_views", "tabletop_views"),
    ],
)
def test_real_folders_are_captured_without_loss(real_data: Path, tmp_path: Path, example: str, folder: str) -> None:
    source = open_source(ROOT / f"docs/examples/{example}.toml", SourceOptions(root=real_data / folder))
    write_capture(tmp_path / "x.capture", source)
    capture = open_source(tmp_path / "x.capture")
    assert not capture.has_clock and set(capture.cameras) == set(source.cameras)
    assert_same(list(source.records()), list(capture.records()))


@pytest.mark.parametrize(
    ("name", "is_there"),
    [
        *(("capture.json", True), ("frames.csv", True), ("joints.npz", True)),
        *(("SHA256SUMS", False), ("frames.csv", False), ("joints.npz", False)),
    ],
)
def test_an_index_that_was_changed_or_is_gone_is_refused(tmp_path: Path, name: str, is_there: bool) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    content = (folder / name).read_bytes()
    (folder / name).unlink()
    if is_there:
        (folder / name).write_bytes(content + b"\n")
    expect_refusal(f"{name}: its checksum differs" if is_there else name, open_source, folder)


@pytest.mark.parametrize(
    ("recipe", "mask", "num_frames", "damaged"),
    [
        (PINCUSHION, "valid/cam0/*", 0, 5),  # of every frame, which are left out
        (LogRecipe(mask_every=1), "human/cam0/000001.png", 5, 1),  # its frame is kept
    ],
)
def test_a_damaged_mask_is_counted(
    tmp_path: Path, recipe: LogRecipe, mask: str, num_frames: int, damaged: int
) -> None:
    _, folder = captured(tmp_path, recipe, options=MASKED if recipe.mask_every else None)
    next(folder.glob(mask)).write_bytes(b"no image")
    source = open_source(folder)
    frames = frames_of(source)
    assert (len(frames), source.loss.damaged) == (num_frames, damaged)
    assert [frame.stamp_ns for frame in frames if frame.human is None] == [START_NS + FRAME_NS][:num_frames]


def test_provenance_says_where_each_image_lies(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe(chunk_size=512))
    with (folder / "provenance.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    log, stamps = (tmp_path / "log.mcap").read_bytes(), [START_NS + i * FRAME_NS for i in range(5)]
    assert [row["color"] for row in rows] == [f"color/cam0/{i:06d}.jpg" for i in range(5)]
    assert {row["color_file"] for row in rows} | {row["depth_file"] for row in rows} == {"log.mcap"}
    assert [int(row["color_log_time_ns"]) for row in rows] == stamps
    assert [int(row["depth_log_time_ns"]) - 3_000_000 for row in rows] == stamps
    offsets = [int(row["color_offset"]) for row in rows]
    assert sorted(set(offsets)) == offsets
    for stamp, offset in zip(stamps, offsets, strict=True):
        assert log[offset] == CHUNK
        first, last = (int.from_bytes(log[offset + at : offset + at + 8], "little") for at in (9, 17))
        assert first <= stamp <= last


def test_the_script_of_the_page_writes_a_capture(tmp_path: Path) -> None:
    (script,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/capture.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(script.splitlines()) <= 35
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, timeout=60)
    source = open_source(tmp_path / "mine.capture")
    first, second = frames_of(source)
    assert (first.stamp_ns, second.stamp_ns, source.loss.damaged) == (0, 100_000_000, 0)
    assert np.unique(second.depth).tolist() == [np.float32(1.251)]
    assert second.T_world_camera[0, 3] == pytest.approx(0.1)
    assert [r.position.tolist() for r in source.records() if isinstance(r, JointState)] == [[0.0]]
    for command in (["check", "--fail-on", "warning"], ["info"]):
        assert main([*command, str(tmp_path / "mine.capture")]) == 0


@pytest.mark.parametrize("kind", ["mcap", "db3", 0.9, 0.5, 0.0])
def test_frames_that_are_gone_from_a_log_are_counted_and_a_capture_that_shrinks_is_refused(
    tmp_path: Path, kind: str | float
) -> None:
    path = file = make_log(tmp_path / "log.mcap", RECIPE)
    if kind == "db3":
        path = as_ros2_folder(path, tmp_path / "bag", StoragePlugin.SQLITE3)
        file = path / "bag.db3"
    if isinstance(kind, float):
        write_capture(tmp_path / "x.capture", open_source(path))
        path, file = tmp_path / "x.capture", tmp_path / "x.capture/frames.csv"
    source = open_source(path)
    whole = sum(1 for _ in source.records())
    records = source.records()
    next(records)
    assert source.loss.damaged == 0
    os.truncate(file, int(file.stat().st_size * (kind if isinstance(kind, float) else 1 / 3)))
    if isinstance(kind, float):
        expect_refusal("frames.csv: changed while it was read", list, records)
        return
    found = 1 + sum(1 for _ in records)
    assert found < whole and source.loss.damaged == 1
    assert f"{whole - found} frames that were there are gone: it changed while it was read" in source.loss.notes[-1]


RECIPE = LogRecipe(num_frames=30, color_format="rgb8", has_joints=False)


@pytest.mark.parametrize(
    ("cameras", "folders"),
    [
        (("../../evil",), {"evil"}),
        (("..",), {"camera"}),
        (("a\0b",), {"a_b"}),
        (("x" * 300,), {"x" * 80}),
        (("line\nbreak",), {"line_break"}),
        (("a b", "a.b"), {"a_b", "a.b"}),
        (("a b", "a\tb"), {"a_b_0", "a_b_1"}),
        (("left/cam", "right/cam"), {"left_cam", "right_cam"}),
    ],
)
def test_a_camera_is_written_below_its_capture(tmp_path: Path, cameras: tuple[str, ...], folders: set[str]) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(cameras=cameras, num_frames=2))
    write_capture(tmp_path / "deep" / "x.capture", open_source(log))
    names = [{path.name for path in (tmp_path / place).iterdir()} for place in ("deep/x.capture/color", ".", "deep")]
    assert names == [folders, {"log.mcap", "deep"}, {"x.capture"}]


def test_a_capture_whose_images_lie_outside_is_refused(tmp_path: Path) -> None:
    _, capture = captured(tmp_path, LogRecipe())
    rows = (capture / "frames.csv").read_bytes()
    replace_file(capture, "frames.csv", rows.replace(b"color/cam0/000000.jpg", b"../secret.jpg"))
    expect_refusal("../secret.jpg lies outside the capture", open_source, capture)


def test_a_capture_of_a_capture_keeps_its_depth_unit(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe(depth_counts=12503), options=SourceOptions(depth_scale=1e-4))
    write_capture(tmp_path / "again.capture", open_source(folder))
    again = [path.read_bytes() for path in sorted((tmp_path / "again.capture").glob("depth/*/*.png"))]
    assert again == [path.read_bytes() for path in sorted(folder.glob("depth/*/*.png"))] != []


CAMERA = {"width": 8, "height": 6, "fx": 9.0, "fy": 9, "cx": 3.5, "cy": 2.5, "depth_scale": 0.001}

HEADER: dict[str, Any] = {
    **{"world_frame": "world", "has_clock": True, "joint_names": ["a"], "cameras": {"cam": CAMERA}},
    **{"loss": {"damaged": 1, "notes": ["x"]}, "sources": {}, "name": "x"},
    **{"tf_frames": {"base": np.eye(4).tolist(), "tip": None}},
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("world_frame", 3), ("has_clock", "yes"), ("joint_names", "ab"), ("joint_names", [1]), ("sources", [])),
        *(("tf_frames", []), ("tf_frames", {"base": "x"}), ("tf_frames", {"base": np.ones((4, 4)).tolist()})),
        *(("loss", {"odd": 1}), ("loss", {"notes": "x"}), ("loss", []), ("loss", {"damaged": "1"}), ("cameras", [])),
        *(("cameras", {"cam": {**CAMERA, key: value}}) for key in CAMERA for value in ("1", -1, 1e400, True, [])
          if not (key in {"cx", "cy"} and value == -1) and not (key in {"width", "height"} and value is True)),
        *(("cameras", {"cam": {k: v for k, v in CAMERA.items() if k != key}}) for key in list(CAMERA)[:-1]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(name: str, value: object) -> None:
    path, lacking = Path("x/capture.json"), {key: entry for key, entry in HEADER.items() if key != name}
    for depth_scale in (0.001, None):
        check_header(path, HEADER | {"cameras": {"cam": CAMERA | {"depth_scale": depth_scale}}})
    for header, said in ((HEADER | {name: value}, f"{name}: expected"), (lacking, f"{name} is missing")):
        expect_refusal(f"x/capture.json: {said}", check_header, path, header)


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
    assert [(row["camera"], row["stamp_ns"]) for row in rows] == [("a", "0"), ("a", "2"), ("a", "3")]
    assert (rows[1]["source"], rows[2]["depth"]) == ("two\nlines, é", "depth/a/3.png")


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
    path = frames(tmp_path, *lines, head=head)
    expect_refusal(f"frames.csv: {said}.*; run `splatctrl ingest` again", FrameRows, path, ("a",))


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
    expect_refusal("missing; the capture was not finished", FileSums, tmp_path / "none")


def interrupted(log: Path, out: Path, monkeypatch: pytest.MonkeyPatch, after: int = 2) -> Path:
    """The partial folder of an ingest that was stopped after some frames."""
    frames = RosLogSource._frames

    def stopping(self: RosLogSource, *, lazily: bool = True) -> Iterator[StoredFrame]:
        yield from islice(frames(self, lazily=lazily), after)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RosLogSource, "_frames", stopping)
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
    written = {path.relative_to(partial): path.stat().st_mtime_ns for path in partial.rglob("*.jpg")}
    assert len(written) == after
    (partial / "color" / "cam1").mkdir(exist_ok=True)
    (partial / "color" / "cam1" / "000004.jpg").write_bytes(b"half")  # killed while it was written
    with (partial / JOURNAL).open("a") as stream:
        stream.write('{"row": {"camera"')
    assert main(["ingest", str(log), "-o", str(out), "-q", "--resume"]) == 0
    ours, whole = (
        {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != "run.json"}
        for folder in (out, tmp_path / "whole")
    )
    assert (ours, partial.exists()) == (whole, False)
    assert {name: (out / name).stat().st_mtime_ns for name in written} == written, "these were not written again"


def test_what_an_interrupted_ingest_left_is_named_and_without_resume_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, out = make_log(tmp_path / "log.mcap"), tmp_path / "x.capture"
    partial = interrupted(log, out, monkeypatch)
    for read in (open_source, describe):
        expect_refusal(
            "an ingest that was interrupted; continue it with the same command and --resume", read, partial
        )
    (partial / "color/cam0/000000.jpg").write_bytes(b"wrong")
    assert main(["ingest", str(log), "-o", str(out), "-q"]) == 0
    source = open_source(out)
    assert (len(list(source.records())), source.loss.damaged) == (10, 0)


def test_going_on_with_other_options_or_frames_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = make_log(tmp_path / "log.mcap"), tmp_path / "x.capture"
    partial = interrupted(log, out, monkeypatch)
    again = ["ingest", str(log), "-o", str(out), "-q", "--resume"]
    assert main([*again, "--depth-scale", "0.002"]) == 2
    assert "options.depth_scale was not given, is 0.002" in capsys.readouterr().err
    assert partial.exists()
    make_log(log, LogRecipe(num_frames=4))
    assert main(again) == 2
    assert "sha256 of log.mcap" in capsys.readouterr().err
    moved = open_source(make_log(tmp_path / "moved.mcap", LogRecipe(tf_delay_ns=5_000_000)))
    expect_refusal("color/cam0/000001.jpg: tx was 0.1, is ", write_capture, partial, moved, error=UsageError)


POSITION = "joint_topics/0/position.npy"


def replace_file(capture: Path, name: str, data: bytes) -> None:
    """Another file of that name, with the right checksum."""
    (capture / name).write_bytes(data)
    with (capture / "SHA256SUMS").open("a") as stream:  # the last line of a name holds
        stream.write(f"{sha256(data).hexdigest()}  {name}\n")


def read(capture: Path) -> int:
    return sum(1 for _ in open_states(capture, SourceOptions(), open_source(capture).joint_names).records())


@pytest.mark.parametrize(
    "array",
    [
        *(np.zeros((2, 2)), np.zeros((3, 2), np.float32), np.asfortranarray(np.zeros((9, 2)))),
        *(np.array(1.0), np.array([{}], dtype=object), 0, 70, -8),
    ],
)
def test_other_rows_than_those_of_the_stamps_or_fewer_than_announced_are_refused(
    tmp_path: Path, array: np.ndarray | int
) -> None:
    _, capture = captured(tmp_path, LogRecipe(num_frames=3))
    assert read(capture) > 0
    if isinstance(array, int):
        replace_file(capture, POSITION, (capture / POSITION).read_bytes()[:array])
    else:
        np.save(tmp_path / "x.npy", array)
        replace_file(capture, POSITION, (tmp_path / "x.npy").read_bytes())
    expect_refusal("joint_topics: cannot be read", read, capture)


@pytest.mark.parametrize("place", ["..", "/tmp", "joint_topics/../.."])
def test_a_folder_outside_the_capture_is_refused(tmp_path: Path, place: str) -> None:
    _, capture = captured(tmp_path, LogRecipe(num_frames=3))
    header = json.loads((capture / "capture.json").read_text())
    header["joint_topics"]["topics"][0]["streams"][0]["folder"] = place
    replace_file(capture, "capture.json", json.dumps(header).encode())
    expect_refusal("lies outside the capture", read, capture)
