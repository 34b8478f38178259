"""Logs as records: what a good log gives, what each kind of bad log says, and how little of a large one is read."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.mcap_file import McapFile
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.mcap_records import DATA_END
from splatctrl_cli.recording.container.raw_log import Damage
from splatctrl_cli.recording.log import survey as surveys
from splatctrl_cli.recording.log.survey import survey
from splatctrl_cli.recording.source import CameraTopics, SourceOptions, describe, open_source
from splatctrl_cli.records import JointState, Record, RgbdFrame
from splatctrl_cli.scene.keyframes import make_view
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
)


def records_of(path: Path, options: SourceOptions | None = None) -> list[Record]:
    return list(open_source(path, options).records())


def refusal(path: Path, options: SourceOptions | None = None) -> str:
    with pytest.raises(InputError) as caught:
        records_of(path, options)
    assert caught.value.exit_code == 4
    assert caught.value.remedy
    return str(caught.value)


def test_a_good_log_gives_every_frame_and_joint_state_whole(tmp_path: Path) -> None:
    source = open_source(make_log(tmp_path / "good.mcap", LogRecipe(color_format="png")))
    frames = [r for r in source.records() if isinstance(r, RgbdFrame)]
    joints = [record for record in source.records() if isinstance(record, JointState)]
    assert source.joint_names == ("joint_a", "joint_b")
    assert joints[3].position == pytest.approx([0.3, -0.3])
    assert joints[3].velocity == pytest.approx([1.0, -1.0])
    assert source.cameras == ("cam0",)
    assert source.has_clock
    assert [f.stamp_ns for f in frames] == [START_NS + i * FRAME_NS for i in range(5)]
    for index, frame in enumerate(frames):
        assert np.array_equal(frame.color, color_pixels(index))
        assert frame.depth[0, 0] == 0
        assert frame.depth[5, 7] == np.float32(1.25)
        assert frame.T_world_camera[:3, 3] == pytest.approx([camera_x(index), 0, 0.5])
        assert (frame.intrinsics.width, frame.intrinsics.height) == (WIDTH, HEIGHT)
        assert (frame.intrinsics.fx, frame.intrinsics.cx) == (30.0, 15.5)
    assert vars(source.loss) == vars(type(source.loss)())


def test_joint_states_come_before_frames_of_the_same_stamp(tmp_path: Path) -> None:
    records = records_of(make_log(tmp_path / "log.mcap", LogRecipe(cameras=("cam0", "cam1"))))
    kinds = [type(record).__name__ for record in records[:3]]
    assert kinds == ["JointState", "RgbdFrame", "RgbdFrame"]
    stamps = [record.stamp_ns for record in records]
    assert stamps == sorted(stamps)


def test_transforms_recorded_after_the_images_still_place_them(tmp_path: Path) -> None:
    early = frames_of(make_log(tmp_path / "early.mcap"))
    late = frames_of(make_log(tmp_path / "late.mcap", LogRecipe(tf_last=True)))
    assert [f.T_world_camera.tolist() for f in early] == [f.T_world_camera.tolist() for f in late]


def test_a_world_frame_inside_the_tree_is_honoured(tmp_path: Path) -> None:
    frame = frames_of(make_log(tmp_path / "log.mcap"), SourceOptions(world_frame="cam0_link"))[3]
    assert frame.T_world_camera[:3, 3] == pytest.approx([0, 0, 0.5])


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
    assert sum(isinstance(record, RgbdFrame) for record in source.records()) == num_frames
    assert (source.loss.unpaired_color, source.loss.unpaired_depth, source.loss.without_pose) == lost
    assert source.loss.damaged == 0


def test_byte_order_and_row_step_do_not_change_the_images(tmp_path: Path) -> None:
    plain = frames_of(make_log(tmp_path / "a.mcap", LogRecipe(color_format="rgb8")))
    odd = frames_of(make_log(tmp_path / "b.mcap", LogRecipe(color_format="rgb8", is_bigendian=True, step_padding=6)))
    for a, b in zip(plain, odd, strict=True):
        assert np.array_equal(a.color, b.color)
        assert np.array_equal(a.depth, b.depth)


def test_unregistered_depth_is_warped_through_tf_and_both_lenses(tmp_path: Path) -> None:
    recipe = LogRecipe(depth_frame="cam0_depth", depth_size=(WIDTH // 2, HEIGHT // 2))
    frame = frames_of(make_log(tmp_path / "log.mcap", recipe))[0]
    assert frame.depth.shape == (HEIGHT, WIDTH)
    covered = frame.depth[4:-4, 6:-4]
    assert covered == pytest.approx(1.25, abs=1e-6)


def test_a_distorted_lens_is_undone_on_colour_and_depth(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(color_format="png", distortion=(0.4, 0.0, 0.0, 0.0, 0.0)))
    frame = frames_of(log)[0]
    k = frame.intrinsics
    assert (k.fx, k.fy, k.cx, k.cy) == (30.0, 30.0, 15.5, 11.5)  # the lens's own
    assert frame.valid is not None
    x, y = (np.arange(WIDTH) - k.cx) / k.fx, (np.arange(HEIGHT)[:, None] - k.cy) / k.fy
    column, row = (30.0 * value * (1 + 0.4 * (x**2 + y**2)) + centre for value, centre in ((x, 15.5), (y, 11.5)))
    seen = (column >= 0) & (column <= WIDTH - 1) & (row >= 0) & (row <= HEIGHT - 1)
    assert np.array_equal(frame.valid, seen) and not seen[0, 0]
    green = np.interp(column, np.arange(WIDTH), color_pixels(0)[0, :, 1])
    assert frame.color[seen, 1] == pytest.approx(green[seen], abs=1.0)
    assert (frame.color[seen, 0] == 40).all() and not frame.color[~seen].any()
    assert (frame.depth[seen] > 0).mean() > 0.99  # all but what the first pixel without depth covers
    assert not frame.depth[~seen].any()
    assert frame.depth[12, 16] == np.float32(1.25)
    assert next(s for s in open_source(log).stored() if not isinstance(s, JointState)).color_file is None


def test_rectified_images_take_the_projection_and_keep_their_pixels(tmp_path: Path) -> None:
    recipe = LogRecipe(
        color_name="image_rect_color", color_format="rgb8", distortion=(0.4, 0, 0, 0, 0), projection_focal=28.0
    )
    frame = frames_of(make_log(tmp_path / "log.mcap", recipe))[0]
    assert (frame.intrinsics.fx, frame.intrinsics.cx, frame.intrinsics.cy) == (28.0, 16.0, 12.0)
    assert np.array_equal(frame.color, color_pixels(0))
    x, y = (np.arange(WIDTH) - 16.0) / 28.0, (np.arange(HEIGHT)[:, None] - 12.0) / 28.0
    column, row = (30.0 * value * (1 + 0.4 * (x**2 + y**2)) + centre for value, centre in ((x, 15.5), (y, 11.5)))
    seen = (column >= 0) & (column <= WIDTH - 1) & (row >= 0) & (row <= HEIGHT - 1)
    assert frame.valid is not None and np.array_equal(frame.valid, seen)
    assert 0.5 < seen.mean() < 1.0 and not make_view(frame, frame.depth > 0).target.counted[~seen].any()


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (0.4, 0.0), (-500.0, 0, 0, 0, 0)])
def test_of_rectified_images_nothing_is_left_out_where_the_lens_is_not_known(
    tmp_path: Path, distortion: tuple[float, ...]
) -> None:
    recipe = LogRecipe(color_name="image_rect_color", distortion=distortion, projection_focal=28.0)
    assert frames_of(make_log(tmp_path / "log.mcap", recipe))[0].valid is None


def test_a_fixed_pose_stands_in_for_tf(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(has_tf=False))
    frames = frames_of(log, SourceOptions(camera_poses={"cam0": (1, 2, 3, 0, 0, 0, 1)}))
    assert len(frames) == 5
    assert frames[4].T_world_camera[:3, 3] == pytest.approx([1, 2, 3])


def test_one_camera_of_several_can_be_chosen(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(cameras=("cam0", "cam1")))
    assert {f.camera for f in frames_of(log, SourceOptions(cameras=("cam1",)))} == {"cam1"}


def test_an_image_that_does_not_decode_is_left_out_and_counted(tmp_path: Path) -> None:
    def spoil(time: int, topic: str, kind: str, content: Any) -> Iterator[tuple[int, str, str, Any]]:
        if topic.endswith("/compressed") and time == START_NS + 2 * FRAME_NS:
            content.data[:] = 0
        yield time, topic, kind, content

    source = open_source(broken_log(tmp_path / "log.mcap", spoil, LogRecipe()))
    assert len([r for r in source.records() if isinstance(r, RgbdFrame)]) == 4
    assert source.loss.damaged == 1
    next(source.records())
    assert source.loss.damaged == 1, "a second pass that ends early forgets nothing"
    words = "compressed image (jpeg): 738 bytes that are not an image file"
    assert source.loss.notes[0] == f"camera cam0 at {START_NS + 2 * FRAME_NS} ns: {words}"


def cut_early(path: Path) -> Path:
    log = make_log(path, LogRecipe(chunk_size=1 << 20))
    log.write_bytes(log.read_bytes()[:200])
    return log


def written(path: Path, name: str, content: bytes) -> Path:
    path.with_name(name).write_bytes(content)
    return path.with_name(name)


NO_FILE = {
    "nothing.mcap: no such file": lambda path: path.with_name("nothing.mcap"),
    "0 bytes": lambda path: written(path, "zero.mcap", b""),
    "unknown kind of file": lambda path: written(path, "notes.txt", b"hello"),
    "does not begin like a .mcap file": lambda path: written(path, "fake.mcap", b"hello"),
    "neither a capture nor a ROS 2 bag": lambda path: path.parent,
    "nothing usable before the damage": cut_early,
}


@pytest.mark.parametrize("words", NO_FILE)
def test_what_is_no_log_is_refused(tmp_path: Path, words: str) -> None:
    assert words in refusal(NO_FILE[words](tmp_path / "log.mcap"))


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
    said = refusal(make_log(tmp_path / "log.mcap", recipe), options)
    assert all(part in said for part in words.split("...")), said


def test_depth_in_tenths_of_a_millimetre_is_implausible_until_the_scale_is_given(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(depth_counts=60000))
    assert "--depth-scale 0.0001" in refusal(log)
    assert frames_of(log, SourceOptions(depth_scale=1e-4))[0].depth[3, 3] == pytest.approx(6.0)


MASKED = SourceOptions(human_topics={"cam0": "/cam0/people/mask"})


def test_masks_come_with_the_image_of_their_stamp(tmp_path: Path) -> None:
    path = make_log(tmp_path / "log.mcap", LogRecipe(mask_every=1))
    frames = frames_of(path, MASKED)
    assert len(frames) == 5
    for index, frame in enumerate(frames):
        assert frame.human is not None
        assert frame.human.dtype == np.uint8
        assert np.array_equal(frame.human, mask_pixels(index) > 0)
    assert all(frame.human is None for frame in frames_of(path))  # nobody asked for them


def test_images_without_a_mask_are_kept_and_noted(tmp_path: Path) -> None:
    source = open_source(make_log(tmp_path / "log.mcap", LogRecipe(mask_every=2)), MASKED)
    frames = [record for record in source.records() if isinstance(record, RgbdFrame)]
    assert [frame.human is not None for frame in frames] == [True, False, True, False, True]
    assert source.loss.notes == ["camera cam0: 2 of 5 images have no mask on /cam0/people/mask within 20 ms"]


def test_a_mask_is_not_taken_for_the_colour_of_a_grey_camera(tmp_path: Path) -> None:
    recipe = LogRecipe(mask_every=1, color_format="mono8", color_name="zz_image")
    path = make_log(tmp_path / "log.mcap", recipe)
    assert frames_of(path, MASKED)[0].color[0].tolist() == [[g, g, g] for g in color_pixels(0)[0, :, 1].tolist()]


def test_a_distorted_lens_is_undone_on_masks_without_new_values(tmp_path: Path) -> None:
    path = make_log(tmp_path / "log.mcap", LogRecipe(mask_every=1, distortion=(0.3, 0.0, 0.0, 0.0, 0.0)))
    human = frames_of(path, MASKED)[0].human
    assert human is not None
    assert set(np.unique(human)) == {0, 1}
    assert not np.array_equal(human, mask_pixels(0) > 0)


def test_a_lens_that_a_person_gives_stands_in_for_camera_info(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(has_info=False))
    frame = frames_of(log, SourceOptions(intrinsics={"cam0": (31.0, 32.0, 15.0, 11.0)}))[0]
    k = frame.intrinsics
    assert (k.fx, k.fy, k.cx, k.cy, k.width, k.height) == (31.0, 32.0, 15.0, 11.0, WIDTH, HEIGHT)
    recorded = make_log(tmp_path / "whole.mcap")
    assert frames_of(recorded, SourceOptions(intrinsics={"cam0": (31.0, 32.0, 15.0, 11.0)}))[0].intrinsics == k


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
    assert summary.facts["messages"] == 20 * 4 + 21
    assert summary.missing == ()
    assert summary.damaged == 0
    assert any("neither checksums nor the rest were read" in note for note in summary.notes)


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
