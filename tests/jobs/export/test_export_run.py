"""A replay, a scene and a field as an MCAP, read back by the libraries that define its messages."""

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import UsageError
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.export.export import ExportRunRequest, export_run
from splatctrl_cli.recording.container.foxglove import read_foxglove
from splatctrl_cli.records import SplatSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import VoxelState
from tests.jobs.stage import QUARTER, Runs, passing, patch_json
from tests.plain import plain_splats
from tests.refused import expect_refusal

Messages = dict[str, list[tuple[int, Any]]]


def read_back(path: Path) -> Messages:
    """Stamps and messages by topic; those in JSON as objects."""
    found: Messages = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        encodings = {channel.topic: channel.message_encoding for channel in reader.get_summary().channels.values()}
        protobuf = [topic for topic, encoding in encodings.items() if encoding == "protobuf"]
        for _, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=protobuf):
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def unpacked(message: Any, names: Mapping[int, str]) -> np.ndarray[Any, Any]:
    """The packed values of a cloud or a grid."""
    fields = [(each.name, names[each.type], each.offset) for each in message.fields]
    size = message.point_stride if hasattr(message, "point_stride") else message.cell_stride
    kind = np.dtype({"names": [f[0] for f in fields], "formats": [f[1] for f in fields],
                     "offsets": [f[2] for f in fields], "itemsize": size})  # fmt: skip
    return np.frombuffer(message.data, kind)


NUMBERS = {1: "u1", 7: "<f4"}  # of foxglove.PackedElementField.NumericType


def logged(path: Path) -> Messages:
    out = path.with_name("out.mcap")
    made = export_run(ExportRunRequest(path=path, out=out))
    found = read_back(out)
    assert {topic: len(messages) for topic, messages in found.items()} == made.metrics["messages"]
    return found


def test_the_splats_of_each_time_are_clouds(run: Runs, tmp_path: Path) -> None:
    clouds = logged(run())["/splats"]
    assert [stamp for stamp, _ in clouds] == [QUARTER * i for i in range(5)]
    for stamp, cloud in clouds:
        splats, values = open_scene(tmp_path / "scene").splats_at(stamp), unpacked(cloud, NUMBERS)
        assert (cloud.frame_id, cloud.timestamp.ToNanoseconds()) == ("world", stamp)
        points = np.column_stack([values[name] for name in ("x", "y", "z", "radius", "label")])
        np.testing.assert_array_equal(points, np.column_stack([splats.centers, splats.radii, splats.labels]))
        np.testing.assert_allclose(values["alpha"] / 255, splats.opacities, atol=0.002)


def test_every_link_is_where_the_robot_has_it_and_our_own_reader_reads_it_too(run: Runs, arm: RobotModel) -> None:
    folder = run()
    found = logged(folder)
    for state, (stamp, message) in zip(passing(), found["/tf"], strict=True):
        assert stamp == state.stamp_ns
        names = [(each.parent_frame_id, each.child_frame_id) for each in message.transforms]
        assert names == [("world", name) for name in arm.frame_names]
        for each in message.transforms:
            place = [getattr(each.translation, axis) for axis in "xyz"]
            T = transform_from(place, [getattr(each.rotation, axis) for axis in "xyzw"])
            np.testing.assert_allclose(T, arm.frame_pose(state.position, each.child_frame_id), atol=1e-9)
    entity = found["/arm/hand"][0][1].entities[0]
    assert len([topic for topic in found if topic.startswith("/arm/")]) > 5
    assert (entity.frame_id, entity.frame_locked) == ("hand", True)
    assert max(entity.triangles[0].indices) < len(entity.triangles[0].points)
    with folder.with_name("out.mcap").open("rb") as stream:
        schema, _, message = next(iter(make_reader(stream).iter_messages(topics=["/tf"])))
    ros = read_foxglove(schema.name, "protobuf", schema.data.decode("latin-1"), message.data)
    assert ros.transforms[0].header.frame_id == "world"


def test_known_space_is_a_grid_of_states_from_its_lower_corner(run: Runs, tmp_path: Path) -> None:
    stamp, space = logged(run())["/known_space"][-1]
    grid = open_scene(tmp_path / "scene").snapshots[-1].occupancy()
    states = grid.states(0.3, 0.7)
    shape = (len(space.data) // space.slice_stride, space.row_count, space.column_count)
    np.testing.assert_array_equal(unpacked(space, NUMBERS)["state"].reshape(shape).T, states)
    assert (states == VoxelState.FREE).any() and stamp == 4 * QUARTER
    corner = [getattr(space.pose.position, axis) for axis in "xyz"]
    np.testing.assert_allclose(corner, grid.origin - grid.voxel / 2)


def test_clearances_are_numbers_and_the_verdict_and_events_are_lines(run: Runs) -> None:
    folder = run()
    found = logged(folder)
    assert found["/clearance"][-1][1]["exact"] == pytest.approx(0.012, abs=1e-4)
    lines = [(message.level, message.message) for _, message in found["/events"]]
    assert lines[0] == (2, json.loads((folder / "run.json").read_text())["verdict"]["sentence"])
    assert any(level == 3 and text.startswith("below-margin: hand[4], worst 0.012 m") for level, text in lines)


def test_a_scene_and_a_field_are_logged_without_an_arm(run: Runs, tmp_path: Path) -> None:
    run()
    assert set(logged(tmp_path / "scene")) == {"/splats", "/known_space"}
    assert (
        main(["sdf-bake", "scene", "-o", "field", "--box=-1.2,-0.2,1.1,-0.8,0.2,1.5", "-q", "--formats", "npz"]) == 0
    )
    found = export_run(ExportRunRequest(path=tmp_path / "field"))
    (_, message), = read_back(found.out)["/distance"]  # fmt: skip
    with np.load(tmp_path / "field" / "field.npz") as grid:
        np.testing.assert_array_equal(unpacked(message, NUMBERS)["distance"], np.ravel(grid["sdf"], order="F"))


def test_rerun_reads_it_without_an_issue(run: Runs) -> None:
    program = shutil.which("rerun")
    if program is None:
        pytest.skip("no rerun here (800 MB): the file is not opened in it; pip install rerun-sdk")
    logged(folder := run())
    out, rrd = folder.with_name("out.mcap"), folder.with_name("out.rrd")

    def rerun(*words: object) -> str:
        return subprocess.run([program, *words], check=True, capture_output=True, text=True).stdout

    assert "warn" not in rerun("mcap", "check", out)
    rerun("mcap", "convert", out, "-o", rrd)
    shown = rerun("rrd", "stats", rrd)
    for component in ("Points3D:positions", "Transform3D:translation", "VoxelGridMap:voxel_indices", "TextLog:text"):
        assert component in shown


def test_without_its_libraries_the_remedy_is_said(run: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = run()
    monkeypatch.setitem(sys.modules, "mcap_protobuf.schema", None)
    expect_refusal(
        r"pip install 'splatctrl-cli\[mcap\]'", export_run, ExportRunRequest(path=folder), error=UsageError
    )
    assert not list(folder.parent.glob("*.mcap*"))


def test_a_run_of_another_kind_is_refused(run: Runs) -> None:
    folder = run()
    patch_json(folder / "run.json", lambda found: found | {"command": "score"})
    expect_refusal("score leaves nothing to log", export_run, ExportRunRequest(path=folder))


def test_the_command_writes_beside_the_run_and_takes_no_option_of_splats(
    run: Runs, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = run()
    assert main(["export", str(folder), "--mcap"]) == 0
    assert folder.with_name("audit.mcap").is_file()
    assert "/splats" in capsys.readouterr().out
    assert main(["export", str(folder), "--mcap", "--isotropic", "--force"]) == 2


def ball(num: int = 400) -> SplatSet:
    directions = np.random.default_rng(0).normal(size=(num, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return plain_splats(
        0.3 * directions + [0.5, 0.0, 0.2],
        0.02,
        colors=0.5 + 0.4 * directions,
        opacities=np.linspace(0.2, 1.0, num),
        labels=np.arange(num) % 3,
    )


def written(folder: Path, splats: SplatSet) -> Path:
    """A scene folder of them."""
    folder.mkdir()
    write_ply(folder / "splats.ply", splats, {"scene": "ball"})
    return folder
