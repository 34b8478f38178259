"""A capture gives back what was put in, to the bit where it can, and notices damage, files that change meanwhile, and
names that lead elsewhere.
"""

import csv
import hashlib
import os
import re
import subprocess
import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.capture.capture import CaptureSource
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.container.mcap_records import CHUNK
from splatctrl_cli.recording.source import SourceOptions, open_source
from splatctrl_cli.records import JointState, Record, RgbdFrame
from tests.recording.container.test_log_formats import as_ros2_folder, assert_same
from tests.recording.log.make_log import FRAME_NS, START_NS, LogRecipe, make_log


def captured(
    tmp_path: Path, recipe: LogRecipe, name: str = "x.capture", options: SourceOptions | None = None
) -> tuple[list[Record], Path]:
    source = open_source(make_log(tmp_path / "log.mcap", recipe), options)
    folder = tmp_path / name
    folder.mkdir()
    write_capture(folder, source)
    return list(source.records()), folder


MASKED = SourceOptions(human_topics={"cam0": "/cam0/people/mask"})


def frames_of(records: list[Record]) -> list[RgbdFrame]:
    return [record for record in records if isinstance(record, RgbdFrame)]


WARPED = LogRecipe(depth_frame="cam0_depth", depth_size=(16, 12), depth_encoding="32FC1", depth_m=1.23457)


@pytest.mark.parametrize(
    "recipe",
    [
        *(LogRecipe(color_format=f, cameras=("cam0", "cam1")) for f in ("jpeg", "png", "rgb8", "bgra8", "mono8")),
        LogRecipe(has_joints=False),
        WARPED,
    ],
)
def test_a_capture_gives_the_same_records(tmp_path: Path, recipe: LogRecipe) -> None:
    before, folder = captured(tmp_path, recipe)
    source = open_source(folder)
    assert_same(before, list(source.records()))
    assert source.joint_names == (("joint_a", "joint_b") if recipe.has_joints else ())
    assert source.has_clock
    assert source.loss.damaged == 0


def test_float_depth_on_a_grid_becomes_png_and_other_depth_stays_float(tmp_path: Path) -> None:
    on_grid, folder = captured(tmp_path, LogRecipe(depth_encoding="32FC1", depth_m=1.2345), "grid.capture")
    assert (folder / "depth/cam0/000000.png").is_file()
    back = frames_of(list(open_source(folder).records()))
    assert np.abs(back[0].depth - frames_of(on_grid)[0].depth).max() <= 1e-6
    off_grid, folder = captured(tmp_path, LogRecipe(depth_encoding="32FC1", depth_m=1.23457), "float.capture")
    assert (folder / "depth/cam0/000000.npy").is_file()
    assert_same(off_grid, list(open_source(folder).records()))


def test_compressed_color_is_kept_byte_for_byte(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    stored = open_source(tmp_path / "log.mcap").stored()
    frames = [item for item in stored if not isinstance(item, JointState)]
    assert [(folder / f"color/cam0/{i:06d}.jpg").read_bytes() for i in range(5)] == [s.color_file for s in frames]


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    _, first = captured(tmp_path, LogRecipe(), "a.capture")
    _, second = captured(tmp_path, LogRecipe(), "b.capture")
    files = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(second) for p in second.rglob("*") if p.is_file())
    assert len(files) == 15
    assert all((first / name).read_bytes() == (second / name).read_bytes() for name in files)


def test_every_file_stands_in_sha256sums_by_name(tmp_path: Path) -> None:
    lens = (0.4, 0.0, 0.0, 0.0, 0.0)  # with a mask of what it saw
    _, folder = captured(tmp_path, LogRecipe(cameras=("cam", "cam-b", "cam0"), distortion=lens))
    sums = dict(reversed(line.split("  ")) for line in (folder / "SHA256SUMS").read_text().splitlines())
    assert list(sums) == sorted(sums)
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} - {"SHA256SUMS"}
    assert set(sums) == files
    assert all(hashlib.sha256((folder / name).read_bytes()).hexdigest() == sums[name] for name in files)


def test_a_damaged_image_is_left_out_and_counted(tmp_path: Path) -> None:
    before, folder = captured(tmp_path, LogRecipe())
    image = folder / "depth/cam0/000002.png"
    image.write_bytes(image.read_bytes()[:-4])
    (folder / "color/cam0/000004.jpg").unlink()
    source = open_source(folder)
    after = list(source.records())
    assert len(after) == len(before) - 2
    assert source.loss.damaged == 2
    next(source.records())
    assert source.loss.damaged == 2, "a second pass that ends early forgets nothing"
    assert "depth/cam0/000002.png: its checksum differs" in source.loss.notes[0]
    assert "color/cam0/000004.jpg: missing" in source.loss.notes[1]


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_an_image_of_another_size_than_its_camera_is_left_out_and_counted(tmp_path: Path, kind: str) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    name = f"{kind}/cam0/000002.{'jpg' if kind == 'color' else 'png'}"
    pixels = np.full((5, 6), 1250, np.uint16) if kind == "depth" else np.zeros((5, 6, 3), np.uint8)
    before = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    cv2.imwrite(str(folder / name), pixels)
    sums = (folder / "SHA256SUMS").read_text()
    after = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text(sums.replace(f"{before}  {name}", f"{after}  {name}"))
    source = open_source(folder)
    assert sum(isinstance(record, RgbdFrame) for record in source.records()) == 4
    assert source.loss.damaged == 1
    assert "expected images of 32x24 as capture.json says" in source.loss.notes[-1]


def test_losses_of_the_log_stay_with_the_capture(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe(tf_frames=3))
    assert open_source(folder).loss.without_pose == 2


def test_a_capture_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    header = folder / "capture.json"
    header.write_text(header.read_text().replace('"version": 1', '"version": 99'))
    with pytest.raises(InputError, match="expected version 1, got 99"):
        open_source(folder)


def test_options_that_a_capture_cannot_honour_are_refused(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe())
    options = SourceOptions()
    for change in ({"depth_scale": 1e-4}, {"world_frame": "base"}, {"holdout": ("0",)}, {"root": tmp_path}):
        with pytest.raises(InputError, match="does not apply to a capture"):
            open_source(folder, replace(options, **change))


@pytest.mark.parametrize(
    ("example", "folder"),
    [
        ("apc_shelf", "apc_shelf/scene-0000"),
        ("open3d_rgbd", "open3d_rgbd/RGBD"),
        ("tabletop_views", "tabletop_views"),
    ],
)
def test_real_folders_are_captured_without_loss(real_data: Path, tmp_path: Path, example: str, folder: str) -> None:
    description = Path(__file__).parents[3] / f"docs/examples/{example}.toml"
    source = open_source(description, SourceOptions(root=real_data / folder))
    out = tmp_path / "x.capture"
    out.mkdir()
    write_capture(out, source)
    capture = open_source(out)
    assert not capture.has_clock
    assert set(capture.cameras) == set(source.cameras)
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
    with pytest.raises(InputError, match=f"{name}: its checksum differs" if is_there else name):
        open_source(folder)


def test_masks_come_back_and_frames_without_one_stay_without(tmp_path: Path) -> None:
    before, folder = captured(tmp_path, LogRecipe(mask_every=2), options=MASKED)
    assert_same(before, list(open_source(folder).records()))
    assert [frame.human is not None for frame in frames_of(before)] == [True, False, True, False, True]


PINCUSHION = LogRecipe(color_format="png", distortion=(0.4, 0.0, 0.0, 0.0, 0.0))


def test_what_the_lens_did_not_see_comes_back_and_is_stored_once(tmp_path: Path) -> None:
    before, folder = captured(tmp_path, PINCUSHION)
    assert_same(before, list(open_source(folder).records()))
    valid = frames_of(before)[0].valid
    assert valid is not None and not valid.all()
    assert len(list((folder / "valid/cam0").iterdir())) == 1
    sums = (folder / "SHA256SUMS").read_text().splitlines()
    assert sum("valid/cam0/" in line for line in sums) == 1 and len(set(sums)) == len(sums)


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
    frames = frames_of(list(source.records()))
    assert (len(frames), source.loss.damaged) == (num_frames, damaged)
    assert [frame.stamp_ns for frame in frames if frame.human is None] == [START_NS + FRAME_NS][:num_frames]


def test_provenance_says_where_each_image_lies(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe(chunk_size=512))
    with (folder / "provenance.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    log = (tmp_path / "log.mcap").read_bytes()
    assert [row["color"] for row in rows] == [f"color/cam0/{i:06d}.jpg" for i in range(5)]
    assert {row["color_file"] for row in rows} | {row["depth_file"] for row in rows} == {"log.mcap"}
    assert [int(row["color_log_time_ns"]) for row in rows] == [START_NS + i * FRAME_NS for i in range(5)]
    assert [int(row["depth_log_time_ns"]) for row in rows] == [START_NS + i * FRAME_NS + 3_000_000 for i in range(5)]
    offsets = [int(row["color_offset"]) for row in rows]
    assert sorted(set(offsets)) == offsets
    for row, offset in zip(rows, offsets, strict=True):
        assert log[offset] == CHUNK
        first, last = (int.from_bytes(log[offset + at : offset + at + 8], "little") for at in (9, 17))
        assert first <= int(row["color_log_time_ns"]) <= last


PAGE = Path(__file__).parents[3] / "docs" / "capture.md"


def test_the_script_of_the_page_writes_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(script) == 1
    assert len(script[0].splitlines()) <= 35
    subprocess.run([sys.executable, "-c", script[0]], cwd=tmp_path, check=True, timeout=60)
    source = open_source(tmp_path / "mine.capture")
    records = list(source.records())
    frames = [record for record in records if isinstance(record, RgbdFrame)]
    assert [frame.stamp_ns for frame in frames] == [0, 100_000_000]
    assert np.unique(frames[1].depth).tolist() == [np.float32(1.251)]
    assert frames[1].T_world_camera[0, 3] == pytest.approx(0.1)
    assert [record.position.tolist() for record in records if isinstance(record, JointState)] == [[0.0]]
    assert source.loss.damaged == 0
    assert main(["check", str(tmp_path / "mine.capture"), "--fail-on", "warning"]) == 0
    assert main(["info", str(tmp_path / "mine.capture")]) == 0


RECIPE = LogRecipe(num_frames=30, color_format="rgb8", has_joints=False)


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_frames_that_are_gone_from_a_log_are_counted(tmp_path: Path, kind: str) -> None:
    path = file = make_log(tmp_path / "log.mcap", RECIPE)
    if kind == "db3":
        path = as_ros2_folder(path, tmp_path / "bag", StoragePlugin.SQLITE3)
        file = path / "bag.db3"
    source = open_source(path)
    whole = sum(1 for _ in source.records())
    assert source.loss.damaged == 0
    records = source.records()
    next(records)
    os.truncate(file, file.stat().st_size // 3)
    found = 1 + sum(1 for _ in records)
    assert found < whole
    assert source.loss.damaged == 1
    assert f"{whole - found} frames that were there are gone: it changed while it was read" in source.loss.notes[-1]


@pytest.mark.parametrize("share", [0.9, 0.5, 0.0])
def test_a_frames_csv_that_shrinks_is_refused(tmp_path: Path, share: float) -> None:
    folder = tmp_path / "x.capture"
    folder.mkdir()
    write_capture(folder, open_source(make_log(tmp_path / "log.mcap", RECIPE)))
    records = open_source(folder).records()
    next(records)
    file = folder / "frames.csv"
    os.truncate(file, int(share * file.stat().st_size))
    with pytest.raises(InputError, match=r"frames.csv: changed while it was read"):
        list(records)


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
    capture = tmp_path / "deep" / "x.capture"
    capture.mkdir(parents=True)
    write_capture(capture, open_source(log))
    assert {path.name for path in (capture / "color").iterdir()} == folders
    assert {path.name for path in tmp_path.iterdir()} == {"log.mcap", "deep"}
    assert {path.name for path in (tmp_path / "deep").iterdir()} == {"x.capture"}


def test_a_capture_whose_images_lie_outside_is_refused(tmp_path: Path) -> None:
    capture = tmp_path / "x.capture"
    capture.mkdir()
    write_capture(capture, open_source(make_log(tmp_path / "log.mcap")))
    frames = capture / "frames.csv"
    frames.write_text(frames.read_text().replace("color/cam0/000000.jpg", "../secret.jpg"))
    with pytest.raises(InputError):
        CaptureSource(capture, SourceOptions())
    sums = capture / "SHA256SUMS"
    lines = [line for line in sums.read_text().splitlines() if not line.endswith("  frames.csv")]
    sums.write_text("\n".join([*lines, f"{sha256(frames.read_bytes()).hexdigest()}  frames.csv"]) + "\n")
    with pytest.raises(InputError, match=r"../secret.jpg lies outside the capture"):
        CaptureSource(capture, SourceOptions())


def test_a_capture_of_a_capture_keeps_its_depth_unit(tmp_path: Path) -> None:
    _, folder = captured(tmp_path, LogRecipe(depth_counts=12503), options=SourceOptions(depth_scale=1e-4))
    write_capture(tmp_path / "again.capture", open_source(folder))
    names = [path.relative_to(folder) for path in sorted(folder.glob("depth/*/*.png"))]
    assert names
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / "again.capture" / name).read_bytes()
