"""Clocks, gaps and several logs of one session."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config.fixed import IMAGES_FEWEST_BACK
from splatctrl_cli.recording.container.log_formats import SessionLog, open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage
from splatctrl_cli.recording.log.survey import StampClock, dropped, first_of_each
from splatctrl_cli.recording.source import SourceOptions, describe, open_session, open_source
from tests.recording.container.test_log_formats import assert_same
from tests.recording.log.make_log import (
    FRAME_NS,
    START_NS,
    LogRecipe,
    Message,
    broken_log,
    built,
    camera_x,
    encoded,
    frames_of,
    make_log,
    set_stamp,
    stamp_of,
    transform,
    write_raw,
)
from tests.refused import expect_refusal


def only(*words: str) -> Callable[[Message], list[Message]]:
    return lambda message: [message] if any(word in message[1] for word in words) else []


def restamped(message: Message, offset_ns: int | None) -> Message:
    """Shift every header stamp of a message, or set it to 0; the log time stays."""
    for item in getattr(message[3], "transforms", None) or [message[3]]:
        set_stamp(item, 0 if offset_ns is None else stamp_of(item) + offset_ns)
    return message


@pytest.mark.parametrize(
    "split",
    [
        [("color", "depth", "tf"), ("joint",)],
        [("color",), ("depth",), ("tf", "joint")],
        [("color", "joint", "/tf_static"), ("depth", "/tf")],
    ],
)
def test_logs_of_one_session_give_the_records_of_the_whole(tmp_path: Path, split: list[tuple[str, ...]]) -> None:
    whole, parts = make_log(tmp_path / "whole.mcap"), []
    for i, words in enumerate(split):
        (tmp_path / f"{i}").mkdir()
        parts.append(make_part(tmp_path / f"{i}/log.mcap", only(*words)))
    source = open_session(parts)
    assert_same(list(open_source(whole).records()), list(source.records()))
    assert (source.name, source.loss.damaged) == ("+".join(part.name for part in parts), 0)
    assert sorted(source.digests()) == [f"{i}/log.mcap" for i in range(len(split))], "each of its own"


def test_a_topic_in_two_logs_keeps_its_order_in_every_pass(tmp_path: Path) -> None:
    """The second file is out of order: without the message before it, its image would come first."""
    content = built("std_msgs/msg/String")
    parts = [
        write_raw(tmp_path / name, [encoded(stamp, topic, content) for topic, stamp in messages], use_chunking=False)
        for name, messages in (("a", [("/image", 50)]), ("b", [("/tf", 99), ("/image", 5)]))
    ]
    log = SessionLog(tuple(map(open_raw_log, parts)))
    assert log.path == tmp_path / "a+b"
    for names in ({"/image"}, None):
        found = log.messages(Damage(), names)
        assert [m.log_time_ns for m in found if m.topic.name == "/image"] == [50, 5]


@pytest.mark.parametrize("stamps", ["header", "log"])
def test_sim_time_in_the_headers_pairs_and_poses_as_any_clock_or_gives_way_on_request(
    tmp_path: Path, stamps: str
) -> None:
    """Headers count from 0 while the log has wall time; /clock itself is not needed."""
    log = make_part(tmp_path / "log.mcap", lambda m: [restamped(m, -START_NS)])
    source = open_source(log, SourceOptions(stamps=stamps))
    first = 0 if stamps == "header" else START_NS
    assert [record.stamp_ns for record in source.records()] == [first + i * FRAME_NS for i in range(5) for _ in "jf"]
    assert frames_of(source)[3].T_world_camera[0, 3] == pytest.approx(camera_x(3))


def test_what_is_no_log_is_not_read_beside_one(tmp_path: Path) -> None:
    log, other = make_log(tmp_path / "log.mcap"), tmp_path / "images.toml"
    other.write_text("")
    expect_refusal(r"images.toml: expected a log, as several were given", open_session, [log, other])


def test_headers_without_stamps_ask_for_the_times_of_logging(tmp_path: Path) -> None:
    def unset(message: Message) -> list[Message]:
        return [message if message[1] == "/tf" or "joint" in message[1] else restamped(message, None)]

    log = make_part(tmp_path / "log.mcap", unset)
    expect_refusal("expected stamps, got 0 in all 5 headers; give --stamps log", open_source, log)
    assert len(frames_of(log, SourceOptions(stamps="log"))) == 5


def looped(message: Message) -> list[Message]:
    """From the sixth frame on, the headers begin again, half a period later."""
    index = (message[0] - START_NS) // FRAME_NS
    return [restamped(message, -5 * FRAME_NS * 3 + FRAME_NS // 2) if index >= 5 * 3 else message]


def test_a_clock_that_goes_back_is_refused_and_the_times_of_logging_taken_on_request(tmp_path: Path) -> None:
    log = make_part(tmp_path / "log.mcap", looped, LogRecipe(num_frames=20))
    back = "image_raw/compressed: the clock of its headers goes back by 1.350 s at 1700000001.500 s"
    message = expect_refusal(back, open_source, log)
    assert "4 images in all; give --stamps log" in message  # the fifth is less than a second behind
    assert any("goes back by 1.350 s" in lack for lack in describe(log).missing)
    frames = frames_of(log, SourceOptions(stamps="log"))
    places = [(f.stamp_ns, f.T_world_camera[0, 3]) for f in frames]
    assert places == [(START_NS + i * FRAME_NS, pytest.approx(camera_x(i))) for i in range(20)]


def test_a_log_that_was_written_out_of_order_has_no_clock_that_goes_back() -> None:
    clock, late = StampClock(), StampClock()
    for stamp in (5, 6, 7, 1, 2, 3, 4):  # as in a file that was merged
        clock.see(stamp * 10**9, stamp * 10**9 + 1)
    for time, stamp in enumerate((5, 6, 0, 7, 0, 8)):  # two headers that were not filled
        late.see(stamp * 10**9, time * 10**9)
    assert not clock.num_back and late.num_back == 2 < IMAGES_FEWEST_BACK


def test_images_that_came_twice_are_taken_once_and_counted(tmp_path: Path) -> None:
    source = open_source(make_part(tmp_path / "log.mcap", lambda m: [m, m] if "image" in m[1] else [m]))
    assert [f.stamp_ns for f in frames_of(source)] == [START_NS + i * FRAME_NS for i in range(5)]
    assert (source.loss.duplicate_images, source.loss.unpaired_color, source.loss.unpaired_depth) == (10, 0, 0)


def test_depth_of_half_the_rate_gives_as_many_frames(tmp_path: Path) -> None:
    def slow(message: Message) -> list[Message]:
        index = round((message[0] - START_NS) / FRAME_NS)
        return [] if "depth" in message[1] and index % 2 else [message]

    source = open_source(make_part(tmp_path / "log.mcap", slow, LogRecipe(num_frames=9)))
    assert [f.stamp_ns for f in frames_of(source)] == [START_NS + i * FRAME_NS for i in range(0, 9, 2)]
    assert (source.loss.unpaired_color, source.loss.unpaired_depth) == (4, 0)


def test_images_that_are_video_do_not_decode_and_are_named(tmp_path: Path) -> None:
    def as_video(message: Message) -> list[Message]:
        if message[1].endswith("/compressed"):
            message[3].format, message[3].data = "h264", np.frombuffer(b"\0\0\0\1\x67 nal", np.uint8)
        return [message]

    said = r"no image of /cam0/.*/compressed can be decoded \(compressed image \(h264\)"
    expect_refusal(said, open_source, make_part(tmp_path / "log.mcap", as_video))


def test_images_that_did_not_come_are_counted_where_there_is_a_rate(tmp_path: Path) -> None:
    missing = {START_NS + index * FRAME_NS for index in (4, 5, 9)}

    def drop(message: Message) -> list[Message]:
        return [] if "color/image" in message[1] and message[0] in missing else [message]

    source = open_source(make_part(tmp_path / "log.mcap", drop, LogRecipe(num_frames=14)))
    assert (len(frames_of(source)), source.loss.dropped_images, source.loss.unpaired_depth) == (11, 3, 3)
    assert "about 3 images were dropped in 2 gaps of a period of 100 ms" in source.loss.notes[0]
    rng = np.random.default_rng(0)
    poisson = np.cumsum(rng.exponential(1e8, 200)).astype(np.int64).tolist()
    jitter = (np.arange(200) * 1e8 + rng.normal(0, 3e6, 200)).astype(np.int64).tolist()
    found = [dropped(stamps)[1] for stamps in (poisson, jitter, [*jitter[:50], *jitter[53:]], jitter[:3])]
    assert found == [0, 0, 3, 0], "not guessed without a rate"
    assert first_of_each(np.array([5, 7, 5, 5, 9, 7])).tolist() == [0, 1, 4]


def test_several_publishers_of_static_transforms_are_joined(tmp_path: Path) -> None:
    """One message a transform, from several nodes, latched late: after the images that need them."""

    def scattered(message: Message) -> list[Message]:
        log_time, topic, kind, content = message
        if topic != "/tf_static":
            return [message]
        return [(log_time + i, topic, kind, built(kind, transforms=[t])) for i, t in enumerate(content.transforms)]

    recipe = LogRecipe(cameras=("cam0", "cam1"), tf_last=True)
    log, whole = make_part(tmp_path / "log.mcap", scattered, recipe), make_log(tmp_path / "whole.mcap", recipe)
    assert_same(list(open_source(whole).records()), list(open_source(log).records()))


def test_a_static_transform_that_changes_is_noted(tmp_path: Path) -> None:
    def moved(message: Message) -> list[Message]:
        log_time, topic, kind, _ = message
        other = built(kind, transforms=[transform(START_NS, "cam0_link", "cam0_optical", (0, 0, 0.7))])
        return [message, (log_time + 1, topic, kind, other)]

    source = open_source(make_part(tmp_path / "log.mcap", lambda m: moved(m) if m[1] == "/tf_static" else [m]))
    assert source.loss.notes == ["tf: cam0_link -> cam0_optical is static and changes; each holds from its stamp on"]
    assert frames_of(source)[0].T_world_camera[2, 3] == pytest.approx(0.7)


def make_part(path: Path, change: Callable[[Message], list[Message]], recipe: LogRecipe | None = None) -> Path:
    """A log whose messages (log time, topic, type, content) are changed, left out or repeated."""
    return broken_log(path, lambda *message: change(message), recipe or LogRecipe())
