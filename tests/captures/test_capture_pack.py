"""A packed capture: standard messages for independent readers, and the same bytes when it is unpacked."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from splatctrl_cli.captures.capture_pack import MARK, pack_capture, unpack_capture
from splatctrl_cli.captures.capture_writer import write_capture
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.sources.source import open_source
from tests.captures.test_capture import frames_of
from tests.containers.test_log_formats import assert_same
from tests.logs.make_log import LogRecipe, camera_x, make_log

RECIPE = LogRecipe(cameras=("cam0", "cam1"))
MASKS = SourceOptions(human_topics={"cam0": "/cam0/people/mask"})


def captured(tmp_path: Path, recipe: LogRecipe, options: SourceOptions | None = None) -> Path:
    folder = tmp_path / "x.capture"
    write_capture(folder, open_source(make_log(tmp_path / "log.mcap", recipe), options))
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    ("recipe", "options"),
    [
        (RECIPE, None),
        (replace(RECIPE, color_format="rgb8"), None),
        (replace(RECIPE, depth_encoding="32FC1", depth_m=1.23457), None),
        (replace(RECIPE, depth_counts=12500), SourceOptions(depth_scale=1e-4)),
        (replace(RECIPE, has_joints=False), None),
        (LogRecipe(mask_every=2), MASKS),
        (LogRecipe(mask_every=2, distortion=(0.4, 0.0, 0.0, 0.0, 0.0)), MASKS),
    ],
    ids=["jpeg", "png", "float depth", "0.1 mm", "no joints", "masks", "valid pixels"],
)
def test_unpacking_gives_the_same_bytes(tmp_path: Path, recipe: LogRecipe, options: SourceOptions | None) -> None:
    folder, packed = captured(tmp_path, recipe, options), tmp_path / "packed.mcap"
    assert pack_capture(folder, packed) == unpack_capture(packed, tmp_path / "back")
    assert contents(tmp_path / "back") == contents(folder)
    assert len(contents(folder)) > 12


def test_a_capture_of_a_capture_keeps_its_depth_unit(tmp_path: Path) -> None:
    folder = captured(tmp_path, replace(RECIPE, depth_counts=12503), SourceOptions(depth_scale=1e-4))
    write_capture(tmp_path / "again.capture", open_source(folder))
    first, again = contents(folder), contents(tmp_path / "again.capture")
    assert {name: data for name, data in first.items() if name.startswith("depth/")} == {
        name: data for name, data in again.items() if name.startswith("depth/")
    }


def test_a_foreign_reader_finds_standard_messages(tmp_path: Path) -> None:
    folder, packed = captured(tmp_path, RECIPE), tmp_path / "packed.mcap"
    pack_capture(folder, packed)
    found: dict[str, list[Any]] = {}
    stores: dict[str, Any] = {}
    with packed.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            if schema.name not in stores:
                stores[schema.name] = get_typestore(Stores.EMPTY)  # by the file's own definitions alone
                stores[schema.name].register(get_types_from_msg(schema.data.decode(), schema.name))
            decoded = stores[schema.name].deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert {len(messages) for topic, messages in found.items() if topic not in {"/tf", "/joint_states"}} == {5}
    stamps = [time for time, _ in found["/cam0/depth/image"]]
    assert stamps == sorted(stamps)
    _, color = found["/cam1/color/image/compressed"][3]
    assert (color.format, color.header.frame_id) == ("jpeg", "cam1_optical_frame")
    assert color.data.tobytes() == (folder / "color/cam1/000003.jpg").read_bytes()
    _, depth = found["/cam1/depth/image"][3]
    assert (depth.encoding, depth.width, depth.height, depth.step) == ("16UC1", 32, 24, 64)
    counts = cv2.imread(str(folder / "depth/cam1/000003.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(depth.data.view("<u2").reshape(24, 32), counts)
    _, file = found["/cam1/depth/image/compressedDepth"][3]
    assert file.format == "16UC1; compressedDepth png"
    assert np.array_equal(cv2.imdecode(file.data[12:], cv2.IMREAD_UNCHANGED), counts)
    _, info = found["/cam0/color/camera_info"][0]
    assert (info.width, info.k[0], info.k[2], info.p[0]) == (32, 30.0, 15.5, 30.0)
    poses = [t for _, tf in found["/tf"] for t in tf.transforms if t.child_frame_id == "cam0_optical_frame"]
    assert [t.transform.translation.x for t in poses] == pytest.approx([camera_x(i) for i in range(5)])
    assert list(found["/joint_states"][2][1].position) == pytest.approx([0.2, -0.2])


def test_a_packed_capture_is_a_log_with_the_same_frames(tmp_path: Path) -> None:
    folder = captured(tmp_path, replace(RECIPE, depth_counts=12500), SourceOptions(depth_scale=1e-4))
    packed = tmp_path / "packed.mcap"
    pack_capture(folder, packed)
    before, after = (frames_of(list(open_source(path).records())) for path in (folder, packed))
    assert len(before) == 10
    assert_same([*before], [*after])


def test_a_damaged_capture_is_not_packed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = captured(tmp_path, RECIPE), tmp_path / "packed.mcap"
    (folder / "color/cam0/000001.jpg").write_bytes(b"other")
    assert main(["capture", "pack", str(folder), "-o", str(out), "-q"]) == 4
    assert "color/cam0/000001.jpg: its checksum differs" in capsys.readouterr().err
    assert not list(tmp_path.glob("packed*"))


def test_the_command_packs_and_unpacks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = captured(tmp_path, RECIPE), tmp_path / "packed.mcap"
    assert main(["capture", "pack", str(folder), "-o", str(out), "-q"]) == 0
    assert main(["capture", "pack", str(folder), "-o", str(out), "-q"]) == 2
    assert main(["capture", "unpack", str(out), "-o", str(tmp_path / "back"), "-q"]) == 0
    assert contents(tmp_path / "back") == contents(folder)
    assert "frames: 10" in capsys.readouterr().out


def _with_attachments(path: Path, *names: str) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata(MARK, {"version": "1"})
        for name in names:
            writer.add_attachment(0, 0, name, "", b"content")
        writer.finish()


@pytest.mark.parametrize("name", ["../evil", "/tmp/evil", "a/../../evil", "a\\..\\evil", "", "a\nevil", "e" * 256])
def test_a_name_that_leads_out_of_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    _with_attachments(tmp_path / "evil.mcap", name)
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match="not the name of a file of a capture"):
        unpack_capture(tmp_path / "evil.mcap", tmp_path / "out")
    assert not [p for p in tmp_path.rglob("evil") if p.is_file()]


@pytest.mark.parametrize(
    "names", [("a.csv", "a.csv"), ("a.csv", "A.CSV"), ("a/b", "a//b"), ("a", "a/b"), ("a/b", "a")]
)
def test_names_that_one_file_system_takes_for_the_same_are_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    _with_attachments(tmp_path / "evil.mcap", *names)
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match="two files of that name"):
        unpack_capture(tmp_path / "evil.mcap", tmp_path / "out")


def test_a_link_out_of_a_capture_is_not_packed(tmp_path: Path) -> None:
    folder = captured(tmp_path, RECIPE)
    (tmp_path / "secret").write_text("x")
    (folder / "notes.txt").symlink_to("../secret")
    with pytest.raises(InputError, match=r"notes.txt: leads out of the capture"):
        pack_capture(folder, tmp_path / "packed.mcap")


@pytest.mark.parametrize("frames", ["", "camera\n0\n", "\xff", 'a,"'])
def test_a_pack_whose_frames_cannot_be_read_is_refused(tmp_path: Path, frames: str) -> None:
    with (tmp_path / "evil.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata(MARK, {"version": "1"})
        writer.add_attachment(0, 0, "frames.csv", "", frames.encode("latin-1"))
        writer.finish()
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=r"frames.csv|SHA256SUMS is missing"):
        unpack_capture(tmp_path / "evil.mcap", tmp_path / "out")


def test_other_logs_and_damaged_packs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a packed capture"):
        unpack_capture(make_log(tmp_path / "other.mcap"), tmp_path / "out")
    folder, packed = captured(tmp_path, RECIPE), tmp_path / "packed.mcap"
    pack_capture(folder, packed)
    content = bytearray(packed.read_bytes())
    content[len(content) // 3] ^= 255
    packed.write_bytes(content)
    with pytest.raises(InputError, match=r"cannot be unpacked|differs from what was packed|is missing"):
        unpack_capture(packed, tmp_path / "out")


def test_rerun_opens_a_packed_capture(tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed: its reader is not tried")
    packed = tmp_path / "packed.mcap"
    pack_capture(captured(tmp_path, RECIPE), packed)
    recording = rerun.RecordingStream("test")
    recording.save(tmp_path / "out.rrd")
    recording.log_file_from_path(packed)
    recording.flush()
    assert (tmp_path / "out.rrd").stat().st_size > 10_000
