"""Depth that was recorded as 16-bit PNG comes into a capture byte for byte, where nothing has to change it."""

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.container.raw_log import RawMessage
from splatctrl_cli.recording.log.decoder import IMAGE, MessageDecoder
from splatctrl_cli.recording.log.messages import read_image
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import JointState, RgbdFrame
from tests.recording.log.make_log import HEIGHT, WIDTH, LogRecipe, T, encoded, make_log, rewritten
from tests.refused import refused

COMPRESSED = "sensor_msgs/msg/CompressedImage"


def with_png_depth(
    log: Path,
    path: Path,
    *,
    form: str = "16UC1; png compressed",
    head: bytes = b"",
    change: Mapping[int, bytes] | None = None,
) -> list[bytes]:
    """Write the log with its raw depth images as PNG files of an unusual level, behind `head`; returns the files.

    change: other bytes for the files of these numbers.
    """
    decoder, files = MessageDecoder(), list[bytes]()

    def as_png(message: RawMessage) -> RawMessage:
        if message.topic.type_name != IMAGE:
            return message
        decoded: Any = decoder.decode(message)
        pixels = read_image(decoded, IMAGE).pixels
        file = bytes(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1])
        files.append((change or {}).get(len(files), file))
        image = np.frombuffer(head + files[-1], np.uint8)
        content = T[COMPRESSED](header=decoded.header, format=form, data=image)
        return encoded(message.log_time_ns, message.topic.name, content)

    rewritten(log, path, as_png)
    return files


@pytest.mark.parametrize(
    ("distortion", "form", "head"),
    [
        ((0.0,) * 5, "16UC1; png compressed", b""),
        ((0.1, 0.0, 0.0, 0.0, 0.0), "16UC1; png compressed", b""),
        ((0.0,) * 5, "16UC1; compressedDepth", bytes(12)),
        ((0.0,) * 5, "16UC1; compressedDepth png", bytes(12)),
    ],
)
def test_recorded_png_depth_is_kept_without_its_head_unless_the_lens_is_undone(
    tmp_path: Path, distortion: tuple[float, ...], form: str, head: bytes
) -> None:
    log = make_log(tmp_path / "raw.mcap", LogRecipe(distortion=distortion))
    files = with_png_depth(log, tmp_path / "png.mcap", form=form, head=head)
    capture = tmp_path / "x.capture"
    capture.mkdir()
    write_capture(capture, open_source(tmp_path / "png.mcap"))
    kept = [path.read_bytes() for path in sorted((capture / "depth" / "cam0").iterdir())]
    assert len(files) == len(kept) == 5
    assert (kept == files) == (distortion[0] == 0.0)
    of_log, of_capture = (
        [r.depth for r in open_source(path).records() if isinstance(r, RgbdFrame)] for path in (log, capture)
    )
    assert all(np.array_equal(a, b) for a, b in zip(of_log, of_capture, strict=True))


def test_what_a_capture_holds_as_it_is_stays_undecoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_log(tmp_path / "raw.mcap", LogRecipe(cameras=("cam0", "cam1")))
    with_png_depth(tmp_path / "raw.mcap", tmp_path / "png.mcap")
    source = open_source(tmp_path / "png.mcap")
    num_decoded, imdecode = 0, cv2.imdecode

    def counting(*args: Any) -> Any:
        nonlocal num_decoded
        num_decoded += 1
        return imdecode(*args)

    monkeypatch.setattr(cv2, "imdecode", counting)
    write_capture(tmp_path / "x.capture", source)
    assert num_decoded == 2 * 2  # the first pair of each camera, for the scale of its depth


@pytest.mark.parametrize("lazily", [True, False])
@pytest.mark.parametrize("wrong", ["damaged", "of another size"])
def test_a_file_that_cannot_be_kept_costs_its_frame(tmp_path: Path, wrong: str, lazily: bool) -> None:
    make_log(tmp_path / "raw.mcap")
    odd = bytes(cv2.imencode(".png", np.full((5, 5), 1250, np.uint16))[1])
    change = {2: odd if wrong == "of another size" else b"\x89PNG\r\n\x1a\n" + bytes(40)}
    with_png_depth(tmp_path / "raw.mcap", tmp_path / "png.mcap", change=change)
    source = open_source(tmp_path / "png.mcap")
    frames = [item for item in (source.stored() if lazily else source.records()) if not isinstance(item, JointState)]
    assert len(frames) == 4 and source.loss.damaged == 1
    words = "expected an image of 32x24, got 5x5" if wrong == "of another size" else "not an image file"
    assert words in source.loss.notes[-1]


def test_a_frame_that_was_left_undecoded_is_refused_where_it_does_not_decode(tmp_path: Path) -> None:
    make_log(tmp_path / "raw.mcap")
    head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 16, 0, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", b"no deflated stream"), (b"IEND", b"")]
    chunks = [struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in parts]
    with_png_depth(tmp_path / "raw.mcap", tmp_path / "png.mcap", change={2: b"\x89PNG\r\n\x1a\n" + b"".join(chunks)})
    source = open_source(tmp_path / "png.mcap")
    frames = [item for item in source.stored() if not isinstance(item, JointState)]
    refused(r"/cam0/depth/image_raw#2: compressed image .* not an image file; copy", lambda: frames[2].frame)
    assert sum(isinstance(item, RgbdFrame) for item in source.records()) == 4  # and counted where it is decoded
    assert source.loss.damaged == 1


@pytest.mark.parametrize("size", [(WIDTH // 2, HEIGHT // 2), (WIDTH, HEIGHT)])
def test_png_depth_of_another_camera_is_registered_and_not_kept(tmp_path: Path, size: tuple[int, int]) -> None:
    make_log(tmp_path / "raw.mcap", LogRecipe(depth_frame="cam0_depth", depth_size=size))
    with_png_depth(tmp_path / "raw.mcap", tmp_path / "png.mcap")
    write_capture(tmp_path / "x.capture", open_source(tmp_path / "png.mcap"))
    of_log, of_capture = (
        [r.depth for r in open_source(tmp_path / name).records() if isinstance(r, RgbdFrame)]
        for name in ("png.mcap", "x.capture")
    )
    assert len(of_log) == 5 and of_log[0].shape == (HEIGHT, WIDTH) and not of_log[0].all()
    assert all(np.abs(a - b).max() <= 1e-6 for a, b in zip(of_log, of_capture, strict=True))


def test_depth_in_another_unit_than_its_cameras_is_counted_again(tmp_path: Path) -> None:
    make_log(tmp_path / "raw.mcap")
    with_png_depth(tmp_path / "raw.mcap", tmp_path / "png.mcap")

    class Mixed:
        """The log, with the last frame's depth in units of half a millimetre."""

        def __init__(self) -> None:
            self._source = open_source(tmp_path / "png.mcap")

        def __getattr__(self, name: str) -> Any:
            return getattr(self._source, name)

        def stored(self) -> Iterator[Any]:
            *frames, last = self._source.stored()
            yield from frames
            yield replace(last, depth_unit=5e-4, read_depth=lambda: last.depth * np.float32(0.5))

    write_capture(tmp_path / "x.capture", Mixed())
    depths = [r.depth[1, 1] for r in open_source(tmp_path / "x.capture").records() if isinstance(r, RgbdFrame)]
    assert depths == pytest.approx([1.25] * 4 + [0.625], abs=1e-6)
