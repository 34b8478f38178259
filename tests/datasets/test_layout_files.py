"""Datasets that are one file of many images."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.captures.capture import CaptureSource
from splatctrl_cli.captures.capture_writer import write_capture
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.sources.describe import describe
from splatctrl_cli.sources.source import open_logs, open_source
from tests.datasets.make_layout import POSES, check, color_of, frames_of, make_sens

SENS = "scene0000_00.sens"


def test_a_sensor_file_is_read_by_itself_too_and_kept_as_it_is(tmp_path: Path) -> None:
    file = make_sens(tmp_path / "scene") / SENS
    check(frames_of(file))
    assert describe(file).kind == "ScanNet sensor file"
    assert open_logs([file]) is None
    assert list(open_source(file).digests()) == [SENS]
    (tmp_path / "x.capture").mkdir()
    write_capture(tmp_path / "x.capture", open_source(file))
    captured = [
        r for r in CaptureSource(tmp_path / "x.capture", SourceOptions()).records() if isinstance(r, RgbdFrame)
    ]
    check(captured)


def test_jpeg_and_plain_words_are_read(tmp_path: Path) -> None:
    frame = frames_of(make_sens(tmp_path, form=".jpg", is_packed=False))[1]
    assert np.abs(frame.color.astype(int) - color_of(1)).max() < 8
    assert frame.depth[3, 3] == np.float32(1370) * np.float32(1e-3)


def test_a_sensor_file_that_was_cut_gives_the_frames_before_and_counts_the_others(tmp_path: Path) -> None:
    source = open_source(make_sens(tmp_path, num_cut=40))
    assert len(list(source.records())) == 2
    assert source.loss.damaged == 1
    assert source.loss.notes == [f"{SENS}: ends after 2 of 3 frames"]


def test_a_frame_whose_tracking_was_lost_or_whose_depth_does_not_unpack_is_counted(tmp_path: Path) -> None:
    file = make_sens(tmp_path) / SENS
    data = bytearray(file.read_bytes())
    pose = data.index(POSES[1].astype("<f4").tobytes())
    data[pose : pose + 64] = np.full(16, -np.inf, "<f4").tobytes()
    data[-20] ^= 0xFF  # in the last image of depth
    file.write_bytes(data)
    source = open_source(file)
    assert [r.stamp_ns for r in source.records() if isinstance(r, RgbdFrame)] == [1_000_000_000]
    assert (source.loss.without_pose, source.loss.damaged) == (1, 1)
    assert source.loss.notes[-1].endswith(f"{SENS}#2: not an image that can be read")


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0, b"\x03", "expected a sensor file of version 4, got 3"),
        (12 + 15 + 256, b"\x00", r"expected colour as PNG or JPEG \(1, 2\).* got 0 and 1"),
        (12 + 15 + 260, b"\x02", r"depth as words, plain or zlib \(0, 1\), got 1 and 2"),
        (12 + 15 + 272, b"\xff\xff\xff\xff", "a size of depth"),
        (12 + 15 + 280, bytes(4), "expected counts per metre"),
    ],
)
def test_a_sensor_file_of_another_kind_is_refused(tmp_path: Path, at: int, value: bytes, words: str) -> None:
    file = make_sens(tmp_path) / SENS
    data = bytearray(file.read_bytes())
    data[at : at + len(value)] = value
    file.write_bytes(data)
    with pytest.raises(InputError, match=words):
        open_source(file)


def test_two_sensor_files_in_a_folder_ask_for_one(tmp_path: Path) -> None:
    folder = make_sens(tmp_path)
    (folder / "b.sens").write_bytes((folder / SENS).read_bytes())
    with pytest.raises(InputError, match=r"2 files \*.sens; give one of them, such as .*b.sens"):
        open_source(folder)
