"""Clocks, gaps and several logs of one session."""

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.log_formats import SessionLog
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.recording.log.survey import StampClock, dropped, first_of_each
from splatctrl_cli.recording.source import describe, open_session, open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import JointState
from tests.recording.container.test_log_formats import assert_same
from tests.recording.log import make_log as maker
from tests.recording.log.make_log import FRAME_NS, START_NS, LogRecipe, broken_log, camera_x, frames_of, make_log
from tests.refused import refused

Message = tuple[int, str, str, Any]


def make_part(path: Path, recipe: LogRecipe, change: Callable[[Message], list[Message]]) -> Path:
    """A log whose messages (log time, topic, type, content) are changed, left out or repeated."""
    return broken_log(path, lambda *message: change(message), recipe)


def only(*words: str) -> Callable[[Message], list[Message]]:
    return lambda message: [message] if any(word in message[1] for word in words) else []


def restamped(message: Message, offset_ns: int) -> Message:
    """With every header moved; the time of logging stays."""
    log_time, topic, kind, content = message
    for item in getattr(content, "transforms", None) or [content]:
        stamp = item.header.stamp.sec * 10**9 + item.header.stamp.nanosec + offset_ns
        item.header.stamp.sec, item.header.stamp.nanosec = divmod(stamp, 10**9)
    return log_time, topic, kind, content


@pytest.mark.parametrize(
    "split",
    [
        [("color", "depth", "tf"), ("joint",)],
        [("color",), ("depth",), ("tf", "joint")],
        [("color", "joint", "/tf_static"), ("depth", "/tf")],
    ],
)
def test_logs_of_one_session_give_the_records_of_the_whole(tmp_path: Path, split: list[tuple[str, ...]]) -> None:
    recipe = LogRecipe(num_frames=8)
    whole = make_log(tmp_path / "whole.mcap", recipe)
    parts = [make_part(tmp_path / f"part{i}.mcap", recipe, only(*words)) for i, words in enumerate(split)]
    source = open_session(parts)
    assert_same(list(open_source(whole).records()), list(source.records()))
    assert source.name == "+".join(part.name for part in parts)
    assert sorted(source.digests()) == sorted(part.name for part in parts)
    assert source.loss.damaged == 0


class ListedLog:
    """A log of (topic, time of logging) in this order."""

    def __init__(self, path: Path, *messages: tuple[str, int]) -> None:
        self.path, self.files, self.container = path, (path,), "list"
        self._messages = messages

    def topics(self) -> tuple[Topic, ...]:
        names = dict.fromkeys(name for name, _ in self._messages)
        return tuple(Topic(name=name, type_name="", encoding="") for name in names)

    def messages(self, _damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        for name, time in self._messages:
            if names is None or name in names:
                yield RawMessage(topic=Topic(name=name, type_name="", encoding=""), log_time_ns=time, data=b"")


def test_a_topic_in_two_logs_keeps_its_order_in_every_pass(tmp_path: Path) -> None:
    """The second file is out of order: without the message before it, its image would come first."""
    log = SessionLog(
        (ListedLog(tmp_path / "a", ("/image", 50)), ListedLog(tmp_path / "b", ("/tf", 99), ("/image", 5)))
    )
    assert log.path == tmp_path / "a+b"
    assert [m.log_time_ns for m in log.messages(Damage(), {"/image"})] == [50, 5]
    assert [m.log_time_ns for m in log.messages(Damage()) if m.topic.name == "/image"] == [50, 5]


def test_files_of_the_same_name_have_digests_of_their_own(tmp_path: Path) -> None:
    parts = []
    for name, words in (("a", ("color", "depth", "tf")), ("b", ("joint",))):
        (tmp_path / name).mkdir()
        parts.append(make_part(tmp_path / name / "log.mcap", LogRecipe(), only(*words)))
    assert sorted(open_session(parts).digests()) == ["a/log.mcap", "b/log.mcap"]


def test_what_is_no_log_is_not_read_beside_one(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap")
    (tmp_path / "images.toml").write_text("")
    refused(r"images.toml: expected a log beside others, got none", open_session, [log, tmp_path / "images.toml"])


def test_sim_time_in_the_headers_pairs_and_poses_as_any_clock(tmp_path: Path) -> None:
    """Headers count from 0 while the log has wall time; /clock itself is not needed."""
    log = make_part(tmp_path / "log.mcap", LogRecipe(), lambda m: [restamped(m, -START_NS)])
    frames = frames_of(open_source(log))
    assert [f.stamp_ns for f in frames] == [i * FRAME_NS for i in range(5)]
    assert frames[3].T_world_camera[0, 3] == pytest.approx(camera_x(3))


def test_times_of_logging_stand_in_for_headers_on_request(tmp_path: Path) -> None:
    log = make_part(tmp_path / "log.mcap", LogRecipe(), lambda m: [restamped(m, -START_NS)])
    source = open_source(log, SourceOptions(stamps="log"))
    frames = frames_of(source)
    assert [f.stamp_ns for f in frames] == [START_NS + i * FRAME_NS for i in range(5)]
    assert frames[3].T_world_camera[0, 3] == pytest.approx(camera_x(3))
    states = [record for record in source.records() if isinstance(record, JointState)]
    assert [state.stamp_ns for state in states] == [START_NS + i * FRAME_NS for i in range(5)]


def test_headers_without_stamps_ask_for_the_times_of_logging(tmp_path: Path) -> None:
    def unset(message: Message) -> list[Message]:
        if message[1] == "/tf" or "joint" in message[1]:
            return [message]
        for item in getattr(message[3], "transforms", None) or [message[3]]:
            item.header.stamp.sec = item.header.stamp.nanosec = 0
        return [message]

    log = make_part(tmp_path / "log.mcap", LogRecipe(), unset)
    refused(r"expected stamps, got 0 in all 5 headers; give --stamps log", open_source, log)
    assert len(frames_of(open_source(log, SourceOptions(stamps="log")))) == 5


def looped(message: Message) -> list[Message]:
    """From the sixth frame on, the headers begin again, half a period later."""
    index = (message[0] - START_NS) // FRAME_NS
    return [restamped(message, -5 * FRAME_NS * 3 + FRAME_NS // 2) if index >= 5 * 3 else message]


def test_a_clock_that_goes_back_is_refused_and_the_times_of_logging_taken_on_request(tmp_path: Path) -> None:
    recipe = LogRecipe(num_frames=20)
    log = make_part(tmp_path / "log.mcap", recipe, looped)
    with pytest.raises(InputError) as caught:
        open_source(log)
    message = str(caught.value)
    assert "image_raw/compressed: the clock of its headers goes back by 1.350 s at 1700000001.500 s" in message
    assert "4 images in all; give --stamps log" in message  # the fifth is less than a second behind
    assert any("goes back by 1.350 s" in lack for lack in describe(log).missing)
    frames = frames_of(open_source(log, SourceOptions(stamps="log")))
    assert [f.stamp_ns for f in frames] == [START_NS + i * FRAME_NS for i in range(20)]
    assert [f.T_world_camera[0, 3] for f in frames] == pytest.approx([camera_x(i) for i in range(20)])


def test_a_log_that_was_written_out_of_order_has_no_clock_that_goes_back() -> None:
    clock, late = StampClock(), StampClock()
    for stamp in (5, 6, 7, 1, 2, 3, 4):  # as in a file that was merged
        clock.see(stamp * 10**9, stamp * 10**9 + 1)
    for time, stamp in enumerate((5, 6, 0, 7, 0, 8)):  # two headers that were not filled
        late.see(stamp * 10**9, time * 10**9)
    assert not clock.num_back and late.num_back == 2 and not late.went_back


def test_images_that_came_twice_are_taken_once_and_counted(tmp_path: Path) -> None:
    log = make_part(tmp_path / "log.mcap", LogRecipe(), lambda m: [m, m] if "image" in m[1] else [m])
    source = open_source(log)
    frames = frames_of(source)
    assert [f.stamp_ns for f in frames] == [START_NS + i * FRAME_NS for i in range(5)]
    assert (source.loss.duplicate_images, source.loss.unpaired_color, source.loss.unpaired_depth) == (10, 0, 0)


def test_depth_of_half_the_rate_gives_as_many_frames(tmp_path: Path) -> None:
    def slow(message: Message) -> list[Message]:
        index = round((message[0] - START_NS) / FRAME_NS)
        return [] if "depth" in message[1] and index % 2 else [message]

    source = open_source(make_part(tmp_path / "log.mcap", LogRecipe(num_frames=9), slow))
    assert [f.stamp_ns for f in frames_of(source)] == [START_NS + i * FRAME_NS for i in range(0, 9, 2)]
    assert (source.loss.unpaired_color, source.loss.unpaired_depth) == (4, 0)


def test_images_that_are_video_do_not_decode_and_are_named(tmp_path: Path) -> None:
    def as_video(message: Message) -> list[Message]:
        if message[1].endswith("/compressed"):
            message[3].format, message[3].data = "h264", np.frombuffer(b"\0\0\0\1\x67 nal", np.uint8)
        return [message]

    log = make_part(tmp_path / "log.mcap", LogRecipe(), as_video)
    refused(r"no image of /cam0/.*/compressed can be decoded \(compressed image \(h264\)", open_source, log)


def test_images_that_did_not_come_are_counted(tmp_path: Path) -> None:
    missing = {START_NS + index * FRAME_NS for index in (4, 5, 9)}

    def drop(message: Message) -> list[Message]:
        return [] if "color/image" in message[1] and message[0] in missing else [message]

    source = open_source(make_part(tmp_path / "log.mcap", LogRecipe(num_frames=14), drop))
    assert len(frames_of(source)) == 11
    assert (source.loss.dropped_images, source.loss.unpaired_depth) == (3, 3)
    assert "about 3 images were dropped in 2 gaps of a period of 100 ms" in source.loss.notes[0]


def test_drops_are_not_guessed_where_there_is_no_rate() -> None:
    rng = np.random.default_rng(0)
    assert dropped(np.cumsum(rng.exponential(1e8, 200)).astype(np.int64).tolist())[1] == 0
    jitter = (np.arange(200) * 1e8 + rng.normal(0, 3e6, 200)).astype(np.int64).tolist()
    assert dropped(jitter)[1] == 0
    assert dropped([*jitter[:50], *jitter[53:]])[1] == 3
    assert dropped(jitter[:3])[1] == 0
    assert first_of_each(np.array([5, 7, 5, 5, 9, 7])).tolist() == [0, 1, 4]


def test_several_publishers_of_static_transforms_are_joined(tmp_path: Path) -> None:
    """One message a transform, from several nodes, latched late: after the images that need them."""

    def scattered(message: Message) -> list[Message]:
        log_time, topic, kind, content = message
        if topic != "/tf_static":
            return [message]
        return [(log_time + i, topic, kind, maker.T[kind](transforms=[t])) for i, t in enumerate(content.transforms)]

    recipe = LogRecipe(cameras=("cam0", "cam1"), tf_last=True)
    log = make_part(tmp_path / "log.mcap", recipe, scattered)
    assert_same(
        list(open_source(make_log(tmp_path / "whole.mcap", recipe)).records()), list(open_source(log).records())
    )


def test_a_static_transform_that_changes_is_noted(tmp_path: Path) -> None:
    def moved(message: Message) -> list[Message]:
        if message[1] != "/tf_static":
            return [message]
        other = maker.transform(START_NS, "cam0_link", "cam0_optical", (0.0, 0.0, 0.7))
        return [message, (message[0] + 1, message[1], message[2], maker.T[message[2]](transforms=[other]))]

    source = open_source(make_part(tmp_path / "log.mcap", LogRecipe(), moved))
    assert source.loss.notes == ["tf: cam0_link -> cam0_optical is static and changes; each holds from its stamp on"]
    assert frames_of(source)[0].T_world_camera[2, 3] == pytest.approx(0.7)
