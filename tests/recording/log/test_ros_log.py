"""Logs as records: what a good log gives, what each kind of bad log says, how little of a large one is read; images
that wait for others, in memory and in a file; and pairs by stamp.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.mcap_file import DATA_END, McapFile
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.recording.log import ros_log
from splatctrl_cli.recording.log import survey as surveys
from splatctrl_cli.recording.log.ros_log import HeldMessages, RosLogSource, planned_images
from splatctrl_cli.recording.log.survey import pair_images, survey
from splatctrl_cli.recording.source import CameraTopics, SourceOptions, describe, open_source
from splatctrl_cli.records import JointState, RgbdFrame
from splatctrl_cli.scene.keyframes import make_view
from tests.recording.container.test_log_formats import assert_same
from tests.recording.log.make_log import (
    FRAME_NS,
    HEIGHT,
    START_NS,
    WIDTH,
    LogRecipe,
    broken_log,
    camera_x,
    color_pixels,
    frames_of,
    make_log,
    mask_pixels,
    messages_of,
    write_raw,
)
from tests.refused import expect_refusal

MASKED = SourceOptions(human_topics={"cam0": "/cam0/people/mask"})


def test_a_good_log_gives_every_frame_and_joint_state_whole(tmp_path: Path) -> None:
    source = open_source(make_log(tmp_path / "good.mcap", LogRecipe(color_format="png", tf_last=True, mask_every=1)))
    records = list(source.records())
    frames, joints = records[1::2], records[::2]  # states before frames of the same stamp
    assert (source.joint_names, source.cameras, source.has_clock) == (("joint_a", "joint_b"), ("cam0",), True)
    assert vars(source.loss) == vars(type(source.loss)())
    for index, (frame, state) in enumerate(zip(frames, joints, strict=True)):
        assert isinstance(frame, RgbdFrame) and isinstance(state, JointState)
        assert state.stamp_ns == frame.stamp_ns == START_NS + index * FRAME_NS
        assert [*state.position, *state.velocity] == pytest.approx([0.1 * index, -0.1 * index, 1.0, -1.0])
        assert np.array_equal(frame.color, color_pixels(index))
        assert frame.human is None, "nobody asked for masks"
        assert (frame.depth[0, 0], frame.depth[5, 7]) == (0, np.float32(1.25))
        assert frame.T_world_camera[:3, 3] == pytest.approx([camera_x(index), 0, 0.5])
        k = frame.intrinsics
        assert (k.width, k.height, k.fx, k.cx) == (WIDTH, HEIGHT, 30.0, 15.5)


def test_a_world_frame_inside_the_tree_is_honoured_and_one_camera_of_several_chosen(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(cameras=("cam0", "cam1")))
    frames = frames_of(log, SourceOptions(world_frame="cam1_link", cameras=("cam1",)))
    assert {frame.camera for frame in frames} == {"cam1"}
    assert frames[3].T_world_camera[:3, 3] == pytest.approx([0, 0, 0.5])


@pytest.mark.parametrize(
    ("recipe", "num_frames", "lost"),
    [
        (LogRecipe(depth_delay_ns=80_000_000), 4, (1, 1, 0)),  # 20 ms before the next colour image
        (LogRecipe(tf_frames=3), 3, (0, 0, 2)),
    ],
)
def test_images_without_partner_or_outside_the_time_of_tf_are_counted(
    tmp_path: Path, recipe: LogRecipe, num_frames: int, lost: tuple[int, int, int]
) -> None:
    source = open_source(make_log(tmp_path / "log.mcap", recipe))
    found, loss = len(frames_of(source)), source.loss
    assert (found, loss.unpaired_color, loss.unpaired_depth, loss.without_pose, loss.damaged) == (
        num_frames,
        *lost,
        0,
    )


def test_unregistered_depth_is_warped_through_tf_and_both_lenses(tmp_path: Path) -> None:
    recipe = LogRecipe(depth_frame="cam0_depth", depth_size=(WIDTH // 2, HEIGHT // 2))
    depth = frames_of(make_log(tmp_path / "log.mcap", recipe))[0].depth
    assert depth.shape == (HEIGHT, WIDTH)
    assert depth[4:-4, 6:-4] == pytest.approx(1.25, abs=1e-6)


def seen_through(centre: tuple[float, float], focal: float) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Column that a pinhole's pixels have in the log's own lens of 0.4, and which of them it saw."""
    x, y = (np.arange(WIDTH) - centre[0]) / focal, (np.arange(HEIGHT)[:, None] - centre[1]) / focal
    column, row = (30.0 * value * (1 + 0.4 * (x**2 + y**2)) + own for value, own in ((x, 15.5), (y, 11.5)))
    return column, (column >= 0) & (column <= WIDTH - 1) & (row >= 0) & (row <= HEIGHT - 1)


def test_a_distorted_lens_is_undone_on_colour_and_depth(tmp_path: Path) -> None:
    recipe = LogRecipe(color_format="png", distortion=(0.4, 0.0, 0.0, 0.0, 0.0), mask_every=1)
    log = make_log(tmp_path / "log.mcap", recipe)
    frame = frames_of(log, MASKED)[0]
    k, (column, seen) = frame.intrinsics, seen_through((15.5, 11.5), 30.0)
    assert (k.fx, k.fy, k.cx, k.cy) == (30.0, 30.0, 15.5, 11.5)  # the lens's own
    assert np.array_equal(frame.valid, seen) and not seen[0, 0]
    green = np.interp(column, np.arange(WIDTH), color_pixels(0)[0, :, 1])
    assert frame.color[seen, 1] == pytest.approx(green[seen], abs=1.0)
    assert (frame.color[seen, 0] == 40).all() and not frame.color[~seen].any()
    assert (frame.depth[seen] > 0).mean() > 0.99  # all but what the first pixel without depth covers
    assert not frame.depth[~seen].any() and frame.depth[12, 16] == np.float32(1.25)
    assert next(s for s in open_source(log).stored() if not isinstance(s, JointState)).color_file is None
    assert set(np.unique(frame.human)) == {0, 1} and not np.array_equal(frame.human, mask_pixels(0) > 0)


def test_rectified_images_take_the_projection_and_keep_their_pixels(tmp_path: Path) -> None:
    recipe = LogRecipe(
        color_name="image_rect_color", color_format="rgb8", distortion=(0.4, 0, 0, 0, 0), projection_focal=28.0
    )
    frame = frames_of(make_log(tmp_path / "log.mcap", recipe))[0]
    seen = seen_through((16.0, 12.0), 28.0)[1]
    assert (frame.intrinsics.fx, frame.intrinsics.cx, frame.intrinsics.cy) == (28.0, 16.0, 12.0)
    assert np.array_equal(frame.color, color_pixels(0)) and np.array_equal(frame.valid, seen)
    assert 0.5 < seen.mean() < 1.0 and not make_view(frame, frame.depth > 0).target.counted[~seen].any()


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (0.4, 0.0), (-500.0, 0, 0, 0, 0)])
def test_of_rectified_images_nothing_is_left_out_where_the_lens_is_not_known(
    tmp_path: Path, distortion: tuple[float, ...]
) -> None:
    recipe = LogRecipe(color_name="image_rect_color", distortion=distortion, projection_focal=28.0)
    assert frames_of(make_log(tmp_path / "log.mcap", recipe))[0].valid is None


def test_an_image_that_does_not_decode_is_left_out_and_counted(tmp_path: Path) -> None:
    def spoil(time: int, topic: str, kind: str, content: Any) -> Iterator[tuple[int, str, str, Any]]:
        if topic.endswith("/compressed") and time == START_NS + 2 * FRAME_NS:
            content.data[:] = 0
        yield time, topic, kind, content

    source = open_source(broken_log(tmp_path / "log.mcap", spoil, LogRecipe()))
    assert (len(frames_of(source)), source.loss.damaged) == (4, 1)
    next(source.records())
    assert source.loss.damaged == 1, "a second pass that ends early forgets nothing"
    words = "compressed image (jpeg): 738 bytes that are not an image file"
    assert source.loss.notes[0] == f"camera cam0 at {START_NS + 2 * FRAME_NS} ns: {words}"


NO_FILE = {
    "nothing.mcap": (None, "nothing.mcap: no such file"),
    "zero.mcap": (b"", "0 bytes"),
    "notes.txt": (b"hello", "unknown kind of file"),
    "fake.mcap": (b"hello", "does not begin like a .mcap file"),
    ".": (None, "neither a capture nor a ROS 2 bag"),
    "cut.mcap": (200, "nothing usable before the damage"),  # of a good log
}


@pytest.mark.parametrize("name", NO_FILE)
def test_what_is_no_log_is_refused(tmp_path: Path, name: str) -> None:
    content, words = NO_FILE[name]
    if content is not None:
        whole = make_log(tmp_path / name, LogRecipe(chunk_size=1 << 20)).read_bytes()
        (tmp_path / name).write_bytes(whole[:content] if isinstance(content, int) else content)
    expect_refusal(words, open_source, tmp_path / name, has_remedy=True)


CAMERA, EYE = SourceOptions(cameras=("cam7",)), CameraTopics(name="eye", color="/nope", depth="/cam0/depth/image_raw")

MASK = LogRecipe(mask_every=1)

TF_TIME = "images 1700000000.000 to 1700000000.400 s, tf 1700000060.000 to 1700000060.400 s"

LACKING: list[tuple[LogRecipe, SourceOptions | None, str]] = [  # ... stands for what else is said
    (LogRecipe(num_frames=0, has_tf=False), None, "holds no messages"),
    (LogRecipe(has_depth=False), None, "no depth topic; colour topics there: /cam0/color/image_raw/compressed"),
    (LogRecipe(has_info=False), None, "camera cam0: topic /cam0/color/image_raw/compressed has no usable CameraInfo"),
    (LogRecipe(has_info=False), None, "give --intrinsics cam0=FX,FY,CX,CY"),
    (LogRecipe(has_tf=False), None, "camera cam0: no tf for frame 'cam0_optical'...--camera-pose cam0="),
    (LogRecipe(), SourceOptions(world_frame="mars"), "tf has no frame 'mars'...cam0_link, cam0_optical, world"),
    (LogRecipe(tf_delay_ns=60_000_000_000), None, "tf has no pose of frame 'cam0_optical' in 'world' at the time of"),
    (LogRecipe(tf_delay_ns=60_000_000_000), None, TF_TIME),
    (LogRecipe(depth_encoding="32FC1", depth_m=1250.0), None, "depth/image_raw: median depth 1250 m is implausible"),
    (LogRecipe(depth_encoding="32FC1", depth_m=1250.0), None, "--depth-scale 0.001"),
    (
        LogRecipe(num_frames=1, depth_delay_ns=35_000_000),
        None,
        "no colour and depth image within 20 ms...35 ms apart",
    ),
    (LogRecipe(depth_size=(16, 12)), None, "depth 16UC1 16x12 of /cam0/depth/image_raw is not registered to colour"),
    (LogRecipe(depth_size=(16, 12)), None, "/cam0/depth/image_raw has no CameraInfo"),
    (MASK, SourceOptions(human_topics={"cam7": "/m"}), "--human-topic cam7=/m: no camera 'cam7'"),
    (
        MASK,
        SourceOptions(human_topics={"cam0": "/m"}),
        "--human-topic cam0=/m: no mono8 or 8UC1 images on that topic",
    ),
    (MASK, SourceOptions(human_topics={"cam0": "/cam0/depth/image_raw"}), "no mono8 or 8UC1 images on that topic"),
    (LogRecipe(), SourceOptions(intrinsics={"cam7": (31.0, 32.0, 15.0, 11.0)}), "no camera 'cam7'; use one of: cam0"),
    (LogRecipe(cameras=("cam0", "cam1")), CAMERA, "no camera 'cam7'; use one of: cam0, cam1"),
    (LogRecipe(), SourceOptions(camera_topics=(EYE,)), "no colour images on topic /nope"),
]


@pytest.mark.parametrize(("recipe", "options", "words"), LACKING)
def test_a_log_names_what_it_lacks(
    tmp_path: Path, recipe: LogRecipe, options: SourceOptions | None, words: str
) -> None:
    log = make_log(tmp_path / "log.mcap", recipe)
    said = expect_refusal("", lambda: list(open_source(log, options).records()), has_remedy=True)
    assert all(part in said for part in words.split("...")), said


@pytest.mark.parametrize("every", [1, 2])
def test_masks_come_with_the_image_of_their_stamp_and_images_without_are_noted(tmp_path: Path, every: int) -> None:
    recipe = LogRecipe(mask_every=every, color_format="mono8", color_name="zz_image")
    source = open_source(make_log(tmp_path / "log.mcap", recipe), MASKED)
    for index, frame in enumerate(frames_of(source)):
        assert (frame.human is None) == (index % every > 0)
        if frame.human is not None:
            assert frame.human.dtype == np.uint8 and np.array_equal(frame.human, mask_pixels(index) > 0)
        grey = color_pixels(index)[0, :, 1].tolist()
        assert frame.color[0].tolist() == [[g, g, g] for g in grey], "a mask is not the colour of a grey camera"
    notes = ["camera cam0: 2 of 5 images have no mask on /cam0/people/mask within 20 ms"]
    assert source.loss.notes == (notes if every == 2 else [])


GIB = 1 << 30


def sparse_log(path: Path, num_bytes: int) -> Path:
    """A small log with an unknown record of `num_bytes` before the end of its data; offsets behind it are wrong by
    that much but for the summary's, which are not used with this record.
    """
    make_log(path, LogRecipe(num_frames=20))
    data = path.read_bytes()
    end = next(part.offset for part in McapFile(path).parts(Damage()) if part.opcode == DATA_END)
    tail = bytearray(data[end:])
    footer = len(tail) - 8 - 20
    moved = [value + num_bytes + 9 if value else 0 for value in struct.unpack_from("<QQ", tail, footer)]
    struct.pack_into("<QQI", tail, footer, *moved, 0)
    with path.open("r+b") as stream:
        stream.seek(end)
        stream.write(struct.pack("<BQ", 0x80, num_bytes))
        stream.seek(end + 9 + num_bytes)
        stream.write(tail)
    return path


def test_a_large_log_is_described_without_being_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = sparse_log(tmp_path / "log.mcap", 10 * GIB)
    assert log.stat().st_size > 10 * GIB
    monkeypatch.setattr(surveys, "survey", None)  # would be called to read it all
    summary = describe(log)
    assert (summary.facts["messages"], summary.missing, summary.damaged) == (20 * 4 + 21, (), 0)
    assert any("neither checksums nor the rest were read" in note for note in summary.notes)


def test_a_lens_or_a_unit_that_a_person_gives_comes_first(tmp_path: Path) -> None:
    given = SourceOptions(intrinsics={"cam0": (31.0, 32.0, 15.0, 11.0)})
    for has_info in (True, False):
        k = frames_of(make_log(tmp_path / "log.mcap", LogRecipe(has_info=has_info)), given)[0].intrinsics
        assert (k.fx, k.fy, k.cx, k.cy, k.width, k.height) == (31.0, 32.0, 15.0, 11.0, WIDTH, HEIGHT)
    log = make_log(tmp_path / "log.mcap", LogRecipe(depth_counts=60000))
    expect_refusal("--depth-scale 0.0001", frames_of, log)
    assert frames_of(log, SourceOptions(depth_scale=1e-4))[0].depth[3, 3] == pytest.approx(6.0)


@pytest.mark.parametrize("has_summary", [True, False])
def test_an_index_counts_what_a_survey_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_summary: bool
) -> None:
    path = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=20))
    if not has_summary:
        end = next(part.offset for part in McapFile(path).parts(Damage()) if part.opcode == DATA_END)
        path.write_bytes(path.read_bytes()[:end])
    expected = {name: topic.count for name, topic in survey(McapLog(path)).topics.items()}
    monkeypatch.setattr(surveys, "LARGE", 0)
    found, notes = surveys.survey_to_describe(open_raw_log(path))
    assert {name: topic.count for name, topic in found.topics.items()} == expected
    assert any("has no summary" in note for note in notes) != has_summary
    assert describe(path).missing == ()


TOPIC = Topic(name="/a", type_name="t", encoding="cdr")

TWO = LogRecipe(cameras=("cam0", "cam1"), mask_every=2)


@pytest.mark.parametrize("held_bytes", [0, 1000, 1 << 20])
def test_a_log_that_keeps_its_topics_apart_gives_the_same_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held_bytes: int
) -> None:
    monkeypatch.setattr(ros_log, "HELD_BYTES", held_bytes)
    log = make_log(tmp_path / "log.mcap", TWO)
    apart = write_raw(tmp_path / "apart.mcap", sorted(messages_of(log), key=lambda m: m.topic.name))
    assert_same(list(open_source(log).records()), list(open_source(apart).records()))


def test_the_plan_takes_few_bytes_a_frame_and_lets_images_go_that_none_needs_any_more(tmp_path: Path) -> None:
    log, held = make_log(tmp_path / "log.mcap", TWO), HeldMessages()
    source = open_source(log)
    assert isinstance(source, RosLogSource)
    plan = source._plan
    assert plan._columns.nbytes == 48 * len(plan) == 48 * 10
    assert [planned.stamp_ns for planned in plan] == sorted(planned.stamp_ns for planned in plan)
    assert [planned.camera.name for planned in plan][:4] == ["cam0", "cam1"] * 2
    assert {topic: int(counts.sum()) for topic, counts in plan.uses().items()} == {
        f"/cam{i}/{name}": 5 for i in range(2) for name in ("color/image_raw/compressed", "depth/image_raw")
    }
    most = [len(held._messages) for _ in planned_images(source._log, plan, Damage(), held)]
    assert len(most) == 10 and max(most) <= 4 and most[-1] == 0
    named = [SourceOptions(cameras=names) for names in (("cam0", "cam1"), ("cam1", "cam0"))]
    orders = [[(s, c) for s, c, _ in open_source(log, options).poses()] for options in named]
    assert orders[0] == orders[1] == sorted(orders[0]), "by stamp, then camera, in whatever order these are named"


def test_held_messages_come_back_and_memory_holds_few_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_log, "HELD_BYTES", 100)
    held = HeldMessages()
    data = [bytes([i]) * 40 for i in range(10)]
    for i, content in enumerate(data):
        held.add(("/a", i), RawMessage(topic=TOPIC, log_time_ns=i, data=content))
    assert sum(len(message.data) for message in held._messages.values()) == 80
    for i in (9, 0, 5, 5, 1, 2, 3):
        assert held.get(("/a", i)) == RawMessage(topic=TOPIC, log_time_ns=i, data=data[i])
    for i in range(10):
        assert held.pop(("/a", i)).data == data[i] and ("/a", i) not in held
    held.add(("/a", 10), RawMessage(topic=TOPIC, log_time_ns=0, data=bytes(100)))
    assert not held._places  # what went has made room


@pytest.mark.parametrize("seed", range(12))
def test_pairs_are_those_of_every_pair_tried_in_turn(seed: int) -> None:
    random = np.random.default_rng(seed)
    color, depth = (random.integers(0, 200, random.integers(0, 40)).tolist() for _ in range(2))
    tolerance, expected = int(random.integers(0, 30)), dict[int, int]()
    for gap, _, _, i, j in sorted((abs(a - b), a, b, i, j) for i, a in enumerate(color) for j, b in enumerate(depth)):
        if gap <= tolerance and i not in expected and j not in expected.values():
            expected[i] = j
    pairs = sorted(expected.items(), key=lambda pair: (color[pair[0]], pair[0]))
    assert [(i, j) for i, j in pair_images(color, depth, tolerance).tolist()] == pairs
