"""Depth that was recorded as 16-bit PNG comes into a capture byte for byte, where nothing has to change it."""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.mcap_writer import mcap_log
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage
from splatctrl_cli.recording.log.decoder import COMPRESSED_IMAGE, IMAGE, MessageDecoder
from splatctrl_cli.recording.log.messages import read_image
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import Intrinsics, JointState
from tests.formats.test_image_file import png_chunk
from tests.plain import plain_frame
from tests.recording.log.make_log import HEIGHT, WIDTH, LogRecipe, built, encoded, frames_of, make_log, rewritten
from tests.refused import expect_refusal


def with_png_depth(
    folder: Path,
    recipe: LogRecipe | None = None,
    *,
    form: str = "16UC1; png compressed",
    head: bytes = b"",
    change: Mapping[int, bytes] | None = None,
) -> tuple[Path, list[bytes]]:
    """A log whose raw depth images are PNG files of an unusual level, behind `head`; and the files.

    change: other bytes for the files of these numbers.
    """
    decoder, files = MessageDecoder(), list[bytes]()

    def as_png(message: RawMessage) -> RawMessage:
        if message.topic.type_name != IMAGE:
            return message
        decoded: Any = decoder.decode(message)
        file = cv2.imencode(".png", read_image(decoded, IMAGE).pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
        files.append((change or {}).get(len(files), bytes(file)))
        content = built(COMPRESSED_IMAGE, header=decoded.header, format=form, data=head + files[-1])
        return encoded(message.log_time_ns, message.topic.name, content)

    return rewritten(make_log(folder / "raw.mcap", recipe), folder / "png.mcap", as_png), files


WIDE = LogRecipe(depth_frame="cam0_depth", depth_size=(WIDTH // 2, HEIGHT // 2))

BESIDE = LogRecipe(depth_frame="cam0_depth")  # of another camera


@pytest.mark.parametrize(
    ("recipe", "form", "head"),
    [
        (LogRecipe(), "16UC1; png compressed", b""),
        (LogRecipe(distortion=(0.1, 0.0, 0.0, 0.0, 0.0)), "16UC1; png compressed", b""),
        (LogRecipe(), "16UC1; compressedDepth", bytes(12)),
        (LogRecipe(), "16UC1; compressedDepth png", bytes(12)),
        (WIDE, "16UC1; png compressed", b""),
        (BESIDE, "16UC1; png compressed", b""),
    ],
)
def test_recorded_png_depth_is_kept_without_its_head_unless_the_lens_is_undone_or_it_is_registered(
    tmp_path: Path, recipe: LogRecipe, form: str, head: bytes
) -> None:
    (log, files), capture = with_png_depth(tmp_path, recipe, form=form, head=head), tmp_path / "x.capture"
    write_capture(capture, open_source(log))
    kept = [path.read_bytes() for path in sorted((capture / "depth" / "cam0").iterdir())]
    assert (len(files), len(kept), kept == files) == (5, 5, recipe == LogRecipe())
    raw, of_log, of_capture = (frames_of(path) for path in (tmp_path / "raw.mcap", log, capture))
    for a, b, c in zip(raw, of_log, of_capture, strict=True):
        assert a.depth.shape == (HEIGHT, WIDTH) and not a.depth.all() and np.array_equal(a.depth, b.depth)
        assert np.abs(b.depth - c.depth).max() <= (1e-6 if recipe.depth_frame else 0)


def test_what_a_capture_holds_as_it_is_stays_undecoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(with_png_depth(tmp_path, LogRecipe(cameras=("cam0", "cam1")))[0])
    decoding = Mock(side_effect=cv2.imdecode)
    monkeypatch.setattr(cv2, "imdecode", decoding)
    write_capture(tmp_path / "x.capture", source)
    assert decoding.call_count == 2 * 2  # the first pair of each camera, for the scale of its depth


@pytest.mark.parametrize("lazily", [True, False])
@pytest.mark.parametrize("wrong", ["damaged", "of another size"])
def test_a_file_that_cannot_be_kept_costs_its_frame(tmp_path: Path, wrong: str, lazily: bool) -> None:
    odd = bytes(cv2.imencode(".png", np.full((5, 5), 1250, np.uint16))[1])
    change = {2: odd if wrong == "of another size" else b"\x89PNG\r\n\x1a\n" + bytes(40)}
    source = open_source(with_png_depth(tmp_path, change=change)[0])
    frames = [item for item in (source.stored() if lazily else source.records()) if not isinstance(item, JointState)]
    assert (len(frames), source.loss.damaged) == (4, 1)
    words = "expected an image of 32x24, got 5x5" if wrong == "of another size" else "not an image file"
    assert words in source.loss.notes[-1]


def test_a_frame_that_was_left_undecoded_is_refused_where_it_does_not_decode(tmp_path: Path) -> None:
    head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 16, 0, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", b"no deflated stream"), (b"IEND", b"")]
    file = b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*part) for part in parts)
    source = open_source(with_png_depth(tmp_path, change={2: file})[0])
    frames = [item for item in source.stored() if not isinstance(item, JointState)]
    said = "/cam0/depth/image_raw#2: compressed image .* not an image file; copy"
    expect_refusal(said, lambda: frames[2].frame)
    assert (len(frames_of(source)), source.loss.damaged) == (4, 1)  # and counted where it is decoded


def test_depth_in_another_unit_than_its_cameras_is_counted_again(tmp_path: Path) -> None:
    source = open_source(with_png_depth(tmp_path)[0])

    class Mixed:
        """The log, with the last frame's depth in units of half a millimetre."""

        def __getattr__(self, name: str) -> Any:
            return getattr(source, name)

        def stored(self) -> Iterator[Any]:
            *frames, last = source.stored()
            yield from frames
            yield replace(last, depth_unit=5e-4, read_depth=lambda: last.depth * np.float32(0.5))

    write_capture(tmp_path / "x.capture", Mixed())
    depths = [frame.depth[1, 1] for frame in frames_of(tmp_path / "x.capture")]
    assert depths == pytest.approx([1.25] * 4 + [0.625], abs=1e-6)


def test_depth_beyond_sixteen_bits_of_millimetres_is_written_as_no_return(tmp_path: Path) -> None:
    depth = np.array([[65.534, 65.535], [66.0, 1000.0]])
    with mcap_log(tmp_path / "far.mcap") as log:
        log.add_frame(plain_frame(depth, Intrinsics(fx=2.0, fy=2.0, cx=0.5, cy=0.5, width=2, height=2)))
    sent = open_raw_log(tmp_path / "far.mcap").messages(Damage())
    image = next(MessageDecoder().decode(message) for message in sent if "depth" in message.topic.name)
    assert read_image(image, IMAGE).pixels.tolist() == [[65534, 0], [0, 0]]
