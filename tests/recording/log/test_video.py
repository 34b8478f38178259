"""Compressed video in logs and beside them: images where their messages were, and what is missing left out."""

import json
from base64 import b64encode
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import av
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from splatctrl_cli import libraries
from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.errors import UsageError
from splatctrl_cli.recording.container.foxglove import DEFINITIONS
from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.recording.log import cameras
from splatctrl_cli.recording.log.decoder import COMPRESSED_IMAGE
from splatctrl_cli.recording.log.video import VideoFileLog, open_log
from splatctrl_cli.recording.source import SourceOptions, describe, open_logs, open_session, open_source
from splatctrl_cli.records import RgbdFrame
from tests.recording.log.make_log import (
    FRAME_NS,
    HEIGHT,
    START_NS,
    WIDTH,
    LogRecipe,
    built,
    color_pixels,
    encoded,
    frames_of,
    header,
    make_log,
    messages_of,
    write_raw,
)
from tests.refused import expect_refusal

NUM, GOP = 12, 5

RECIPE = LogRecipe(has_joints=False, num_frames=NUM, color_format="png")

FFMPEG = (
    "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\nbool is_bigendian\n"
    "uint8[] data\n"
)  # ffmpeg_image_transport_msgs/msg/FFMPEGPacket.msg

Change = Callable[[list[tuple[int, bytes]]], list[tuple[int, bytes]]]


def packets(codec: str = "libx264", num: int = NUM) -> list[bytes]:
    """The colour of a log's frames, a packet each, a key frame every GOP; as good as lossless."""
    context: Any = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv444p"
    context.time_base, context.framerate = Fraction(1, 10), Fraction(10)
    context.gop_size, context.max_b_frames, context.thread_count = GOP, 0, 1
    context.options = {
        **{"tune": "zerolatency", "qp": "4", "sc_threshold": "0"},
        "x265-params": "log-level=none:qp=4:min-cu-size=8:ctu=16:scenecut=0:pools=none:frame-threads=1",
    }
    frames = [av.VideoFrame.from_ndarray(color_pixels(i), format="rgb24") for i in range(num)]
    found: list[bytes] = []
    for i, frame in enumerate(frames):
        frame.pts = i
        found += [bytes(packet) for packet in context.encode(frame)]
    return found + [bytes(packet) for packet in context.encode(None)]


def as_message(message: RawMessage, data: bytes, kind: str, form: str) -> RawMessage:
    """A packet in place of an image's message."""
    stamp, frame, topic = message.log_time_ns, "cam0_optical", message.topic.name
    seconds, nanoseconds = divmod(stamp, 10**9)
    if kind in {"protobuf", "json"}:
        said = CompressedVideo(frame_id=frame, data=data, format=form)
        said.timestamp.FromNanoseconds(stamp)
        fields = {"timestamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": frame, "format": form}
        text = json.dumps({**fields, "data": b64encode(data).decode()}).encode()
        definition = build_file_descriptor_set(CompressedVideo).SerializeToString().decode("latin-1")
        channel = Topic(name=topic, type_name="foxglove.CompressedVideo", encoding=kind, definition=definition)
        return replace(message, topic=channel, data=said.SerializeToString() if kind == "protobuf" else text)
    store = get_typestore(Stores.ROS2_HUMBLE)
    name = "foxglove_msgs/msg/CompressedVideo" if kind == "cdr" else "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
    store.register(get_types_from_msg(DEFINITIONS[name] if kind == "cdr" else FFMPEG, name))
    fields = {"timestamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame, "format": form}
    if kind == "ffmpeg":
        fields = {"header": header(stamp, frame, store), "width": WIDTH, "height": HEIGHT, "encoding": form}
    return encoded(stamp, topic, built(name, store, data=data, **fields), store)


def video_log(
    path: Path,
    kind: str = "cdr",
    form: str = "h264",
    *,
    codec: str = "libx264",
    change: Change = lambda numbered: numbered,
) -> Path:
    """A log of RECIPE whose colour is video, its packets by number as `change` leaves them."""
    log = make_log(path.with_name("images.mcap"), RECIPE)
    kept, number, written = dict(change(list(enumerate(packets(codec))))), count(), []
    for message in messages_of(log):
        if message.topic.type_name != COMPRESSED_IMAGE:
            written.append(message)
        elif (packet := kept.get(next(number))) is not None:
            written.append(as_message(message, packet, kind, form))
    return write_raw(path, written)


def numbers_of(frames: list[RgbdFrame]) -> list[int]:
    """Of the images, by what is in them; it must be what their stamps say."""
    numbers = [(frame.stamp_ns - START_NS) // FRAME_NS for frame in frames]
    for number, frame in zip(numbers, frames, strict=True):
        assert np.abs(frame.color.astype(int) - color_pixels(number)).max() <= 4
    return numbers


def assert_same(found: list[RgbdFrame], folder: Path) -> None:
    """The frames are those of the log of images."""
    assert numbers_of(found) == list(range(NUM))
    for frame, same in zip(found, frames_of(folder / "images.mcap"), strict=True):
        assert np.array_equal(frame.depth, same.depth) and frame.intrinsics == same.intrinsics
        assert np.array_equal(frame.T_world_camera, same.T_world_camera)


@pytest.mark.parametrize(
    ("kind", "form", "codec"),
    [
        ("protobuf", "h264", "libx264"),
        ("json", "h264", "libx264"),
        ("cdr", "h265", "libx265"),
        ("ffmpeg", "hevc", "libx265"),
        ("ffmpeg", "libx264;yuv420p", "libx264"),
    ],
)
def test_every_image_of_a_video_has_its_stamp_pose_and_depth(
    tmp_path: Path, kind: str, form: str, codec: str
) -> None:
    source = open_source(video_log(tmp_path / "video.mcap", kind, form, codec=codec))
    assert_same(frames_of(source), tmp_path)
    assert source.loss.damaged == 0


def cut_key_frame(numbered: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    return [(i, data[: len(data) // 2] if i == GOP else data) for i, data in numbered]


def test_info_and_check_take_video_for_the_colour_that_it_is(tmp_path: Path) -> None:
    path = video_log(tmp_path / "video.mcap")
    rows = {str(row[0]): row[1:] for row in describe(path).grids[0].rows}
    assert rows["/cam0/color/image_raw/compressed"][:3] == ["foxglove_msgs/msg/CompressedVideo", "video", NUM]
    reports = (check_log(open_log(log), SourceOptions()) for log in (path, tmp_path / "images.mcap"))
    video, images = ([finding.code for finding in report.findings] for report in reports)
    assert video == images


BEFORE = "3 images of video before its first key frame left out: record a key frame every second, or cut the log"

BEHIND = "2 images of video that follow missing or damaged ones, up to the next key frame"


@pytest.mark.parametrize(
    ("form", "codec", "change", "numbers", "said"),
    [
        ("h264", "libx264", lambda numbered: numbered[2:], [*range(GOP, NUM)], BEFORE),
        # FFmpeg shows those of H.264, with the blocks of the wrong image
        ("h264", "libx264", lambda numbered: numbered[:2] + numbered[3:], [0, 1, *range(GOP, NUM)], BEHIND),
        ("h265", "libx265", lambda numbered: numbered[:2] + numbered[3:], [0, 1, *range(GOP, NUM)], BEHIND),
        ("h264", "libx264", cut_key_frame, [*range(GOP), *range(2 * GOP, NUM)], ""),
    ],
)
def test_images_that_lack_one_before_them_are_left_out_up_to_the_next_key_frame_and_counted(
    tmp_path: Path, form: str, codec: str, change: Change, numbers: list[int], said: str
) -> None:
    source = open_source(video_log(tmp_path / "video.mcap", form=form, codec=codec, change=change))
    num_missing = 0 if change is cut_key_frame else 2 if said == BEFORE else 1  # these leave no message
    assert (numbers_of(frames_of(source)), source.loss.damaged) == (numbers, NUM - num_missing - len(numbers))
    assert said in source.loss.notes[0]


def test_video_without_any_key_frame_or_of_another_codec_is_refused(tmp_path: Path) -> None:
    log = video_log(tmp_path / "video.mcap", change=lambda numbered: [n for n in numbered if n[0] % GOP])
    expect_refusal(r"no image of the video can be decoded \(.*: 9 images of video before its", open_source, log)
    log = video_log(tmp_path / "video.mcap", form="vp9")
    expect_refusal(r"colour is video \(/cam0/.*\), which is neither H.264 nor H.265; decode it", open_source, log)


def test_without_the_library_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, mp4 = video_log(tmp_path / "video.mcap"), write_mp4(tmp_path / "color.mp4")
    monkeypatch.setattr("splatctrl_cli.recording.log.video.is_installed", lambda name: False)
    monkeypatch.setattr(cameras, "is_installed", lambda name: False)
    expect_refusal("the library av is not installed; pip install 'splatctrl-cli[video]'", open_source, log)
    monkeypatch.setattr(libraries, "import_module", Mock(side_effect=ImportError("av")))
    (tmp_path / "color.csv").write_text("0.0\n")
    expect_refusal(r"video files need the library av.*splatctrl-cli\[video\]", open_logs, [mp4], error=UsageError)


def beside(folder: Path, lines: list[str], *, b_frames: int = 0) -> Path:
    """The log without its colour, and a video beside it whose stamps are these lines."""
    log = make_log(folder / "images.mcap", RECIPE)
    write_raw(folder / "run.mcap", [m for m in messages_of(log) if m.topic.type_name != COMPRESSED_IMAGE])
    (folder / "color.csv").write_text("\n".join(lines) + "\n")
    return write_mp4(folder / "color.mp4", b_frames=b_frames)


def write_mp4(path: Path, *, b_frames: int = 0) -> Path:
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv444p"
        stream.options = {"qp": "4"}
        stream.codec_context.max_b_frames = b_frames
        for i in range(NUM):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(color_pixels(i), format="rgb24")))
        container.mux(stream.encode(None))
    return path


STAMPS = [START_NS + i * FRAME_NS for i in range(NUM)]


@pytest.mark.parametrize("b_frames", [0, 3])
@pytest.mark.parametrize(
    "lines",
    [
        [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in STAMPS],
        ["# ns", *(str(stamp) for stamp in STAMPS)],
        ["frame,timestamp_us", *(f"{i},{stamp // 1000}" for i, stamp in enumerate(STAMPS))],
        [str(stamp // 10**6) for stamp in STAMPS],
    ],
    ids=["seconds", "nanoseconds", "microseconds", "milliseconds"],
)
def test_a_video_file_beside_a_log_is_its_colour(tmp_path: Path, lines: list[str], b_frames: int) -> None:
    video = beside(tmp_path, lines, b_frames=b_frames)
    source = open_session([tmp_path / "run.mcap", video])
    assert_same(frames_of(source), tmp_path)
    assert set(source.digests()) == {"run.mcap", "color.mp4", "color.csv"}
    assert describe(video).kind == "video"


def test_stamps_that_are_missing_or_too_few_or_unreadable_are_named(tmp_path: Path) -> None:
    video = beside(tmp_path, [str(stamp) for stamp in STAMPS[1:]])
    expect_refusal("color.mp4: 12 images, but 11 stamps in color.csv", open_session, [tmp_path / "run.mcap", video])
    for lines, words in (
        (["1 2", "2 3"], "expected a stamp a line, or columns whose first line names one"),
        (["frame,image", "0,1"], "expected a stamp a line"),
        (["1.0", "soon"], "expected a time, got 'soon'"),
        ([], "expected a stamp a line"),
    ):
        (tmp_path / "color.csv").write_text("\n".join(lines))
        expect_refusal(words, VideoFileLog, video)
    (tmp_path / "color.csv").unlink()
    expect_refusal("color.mp4: expected a file of stamps next to it, got none; write color.csv", VideoFileLog, video)
    (tmp_path / "other.txt").write_text("\n".join(map(str, STAMPS)))
    mkv = write_mp4(tmp_path / "other.mkv")
    mkv.write_bytes(mkv.read_bytes()[: mkv.stat().st_size // 3])
    expect_refusal(r"other\.mkv: \d images, but 12 stamps in other\.txt", open_session, [tmp_path / "run.mcap", mkv])
