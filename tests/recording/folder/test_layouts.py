"""Folders of public datasets, opened by their own files: small trees with a known pose and depth."""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.folder.image_folder import LAYOUTS, layout_of
from splatctrl_cli.recording.folder.layout import Layout
from splatctrl_cli.recording.source import SourceOptions, describe, open_source
from tests.recording.folder.make_layout import (
    EXAMPLES,
    GIVEN,
    POSES,
    WIDTH,
    K,
    changed_json,
    check,
    color_of,
    make_bop,
    make_frames,
    make_mvsnet,
    make_nerfstudio,
    make_redwood,
    make_scannet,
    make_tum,
    matrix_text,
)
from tests.recording.log.make_log import frames_of
from tests.refused import expect_refusal


@pytest.fixture(params=[layout for layout in LAYOUTS if layout.name in EXAMPLES], ids=lambda layout: layout.name)
def layout(request: pytest.FixtureRequest) -> Layout:
    """Each layout that needs no description; tests of one of its own are below, and in test_layout_forms.py."""
    found: Layout = request.param
    return found


def test_a_layout_is_known_by_its_files_described_and_read_to_the_value(tmp_path: Path, layout: Layout) -> None:
    example = EXAMPLES[layout.name]
    folder = example.make(tmp_path / "freiburg3")
    assert layout_of(folder) is layout
    summary = describe(folder)
    assert (summary.kind, summary.grids[0].rows) == (layout.name, [["camera", 3]])
    source = open_source(folder, example.options)
    frames = frames_of(source)
    check(frames, example.unit)
    assert source.has_clock == (example.stamps_ns is not None)
    first, step = example.stamps_ns or (0, 1_000_000_000)
    assert [frame.stamp_ns for frame in frames] == [first + i * step for i in range(3)]


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"[]", b"null", b"1 2 3\n", b"\xff\xfe nonsense \x00", b'{"0": 3, "frames": [1]}']
)
def test_a_damaged_text_of_a_layout_is_refused_in_one_line_or_read_around(
    tmp_path: Path, layout: Layout, content: bytes
) -> None:
    make = EXAMPLES[layout.name].make
    whole = make(tmp_path / "whole")
    names = [path.relative_to(whole) for path in whole.rglob("*") if path.suffix not in {"", ".png"}]
    assert names
    for number, name in enumerate(names):
        folder = make(tmp_path / f"freiburg3_{number}")
        (folder / name).write_bytes(content)
        try:
            list(open_source(folder, SourceOptions()).records())
        except InputError as error:
            assert "\n" not in str(error) and error.remedy


def test_tum_images_without_partner_or_pose_are_counted(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "freiburg3")
    for name, kept in (("depth.txt", slice(1, None)), ("groundtruth.txt", slice(5))):
        (folder / name).write_text("".join((folder / name).read_text().splitlines(keepends=True)[kept]))
    source = open_source(folder, GIVEN)
    assert len(list(source.records())) == 1
    assert (source.loss.unpaired_color, source.loss.unpaired_depth, source.loss.without_pose) == (1, 0, 1)


def test_an_open3d_scene_goes_by_number_where_there_are_more_poses(tmp_path: Path) -> None:
    log = make_redwood(tmp_path) / "trajectory.log"
    text = re.sub(
        r"^(\d) \1 \d$", lambda m: f"{int(m[1]) + 9} {int(m[1]) + 9} {int(m[1]) + 10}", log.read_text(), flags=re.M
    )
    log.write_text(f"0 0 1\n{matrix_text(np.eye(4))}{text}")
    check(frames_of(tmp_path))


def test_an_open3d_scene_without_intrinsics_asks_for_them(tmp_path: Path) -> None:
    folder = make_redwood(tmp_path / "scene")
    (folder / "camera_intrinsic.json").unlink()
    expect_refusal("no camera_intrinsic.json in it or above it; give --intrinsics", open_source, folder)
    check(frames_of(folder, GIVEN))


@pytest.mark.parametrize("sequence", ["", "data", "own"])
def test_seven_scenes_need_no_default_where_intrinsics_are_given_or_their_own(tmp_path: Path, sequence: str) -> None:
    folder = make_frames(tmp_path, sequence.replace("own", "data"))
    matrix = [[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]
    if sequence == "own":
        (folder / "camera-intrinsics.txt").write_text("\n".join(" ".join(map(str, row)) for row in matrix))
    source = open_source(folder, None if sequence == "own" else GIVEN)
    check(frames_of(source))  # 65535 is no depth
    assert source.loss.notes == [] and not source.has_clock


def test_a_bop_scene_without_poses_needs_a_camera_that_stands_still(tmp_path: Path) -> None:
    folder = make_bop(tmp_path, with_poses=False)
    expect_refusal("scene_camera.json has no pose for any image.*give --camera-pose", open_source, folder)
    still = open_source(folder, SourceOptions(camera_poses={"camera": (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)}))
    assert [frame.T_world_camera[:3, 3].tolist() for frame in frames_of(still)] == [[1.0, 2.0, 3.0]] * 3
    assert "camera camera: is fixed where --camera-pose puts it" in still.loss.notes[0]


def test_frames_with_a_lens_of_their_own_become_a_camera_that_a_capture_keeps_apart(tmp_path: Path) -> None:
    folder = make_nerfstudio(tmp_path / "in", fl_x=20.0)
    write_capture(tmp_path / "out", open_source(folder))
    for place in (folder, tmp_path / "out"):
        found = [(frame.camera, frame.intrinsics.fx) for frame in frames_of(place)]
        assert found == [("camera", 10.0), ("camera-1", 20.0), ("camera", 10.0)]
    held = open_source(folder, SourceOptions(holdout=("0", "1")))
    expect_refusal("camera holdout changes its intrinsics", write_capture, tmp_path / "again", held)


def test_a_nerfstudio_frame_without_depth_is_named(tmp_path: Path) -> None:
    folder = make_nerfstudio(tmp_path)
    changed_json(folder / "transforms.json", lambda content: content["frames"][2].pop("depth_file_path"))
    expect_refusal("frame_2.png: depth_file_path is missing (1 of 3 frames)", open_source, folder)


def test_a_folder_of_scenes_names_them(tmp_path: Path) -> None:
    make_redwood(tmp_path / "kitchen")
    make_scannet(tmp_path / "scene0000_00")
    (tmp_path / "notes").mkdir()
    (tmp_path / "run.bag").write_bytes(b"")
    expect_refusal("give one that is in it: kitchen (Open3D scene), run.bag, scene0000_00", open_source, tmp_path)
    expect_refusal("of no known kind; give one that is in it: kitchen", describe, tmp_path)


def test_files_that_are_named_but_not_there_are_counted(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "freiburg3")
    next((folder / "depth").iterdir()).unlink()
    source = open_source(folder, GIVEN)
    assert len(list(source.records())) == 2
    assert (source.loss.unpaired_color, source.loss.unpaired_depth) == (1, 0)
    assert "1 of 3 views lack a file" in source.loss.notes[0]
    (folder / "rgb").rename(tmp_path / "rgb")
    (folder / "rgb.txt").write_text((folder / "rgb.txt").read_text().replace("rgb/", "../rgb/"))
    expect_refusal("is not in", open_source, folder, GIVEN)


def test_a_name_that_no_camera_has_is_refused(tmp_path: Path) -> None:
    still = SourceOptions(camera_poses={"cam0": (0, 0, 0, 0, 0, 0, 1)})
    expect_refusal("no camera 'cam0'; use one of: camera", open_source, make_redwood(tmp_path), still)
    bop = make_bop(tmp_path / "bop")
    expect_refusal("--intrinsics does not apply to a BOP scene", open_source, bop, GIVEN)
    held = frames_of(bop, SourceOptions(holdout=("1",)))
    assert [frame.camera for frame in held] == ["camera", "holdout", "camera"]


def test_a_tum_folder_without_its_poses_names_the_file(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "rgbd_dataset_freiburg3_x")
    (folder / "groundtruth.txt").unlink()
    expect_refusal("groundtruth.txt: no such file.*; copy it too, or give --camera-pose", open_source, folder)
    assert open_source(folder, SourceOptions(camera_poses={"camera": (0, 0, 0, 0, 0, 0, 1)})).cameras == ("camera",)


def without_depth(folder: Path, kind: str) -> Path:
    """Colour, poses and lenses of three views, as sets for novel views have them."""
    if kind == "MVSNet":
        shutil.rmtree(make_mvsnet(folder) / "depths")
        return folder
    content = json.loads((make_nerfstudio(folder) / "transforms.json").read_text())
    for frame in content["frames"]:
        del frame["depth_file_path"]
        if kind == "Blender":
            frame.update(file_path=frame["file_path"].removesuffix(".png"), rotation=0.01)
    short = {"camera_angle_x": 2 * math.atan(WIDTH / 2 / K[0]), "frames": content["frames"]}
    (folder / "transforms.json").unlink()
    name, told = ("transforms_train.json", short) if kind == "Blender" else ("transforms.json", content)
    (folder / name).write_text(json.dumps(told))
    return folder


@pytest.mark.parametrize("kind", ["nerfstudio", "Blender", "MVSNet"])
def test_views_without_depth_say_so_first_and_what_works_without(tmp_path: Path, kind: str) -> None:
    folder = without_depth(tmp_path / "set", kind)
    said = "depth is missing: none of its 3 views has any; add "
    message = expect_refusal(said, open_source, folder)
    assert "info, score and reconstruct --points CLOUD.ply work without depth" in message
    assert describe(folder).missing[0].startswith(said)
    frames = frames_of(open_source(folder, needs_depth=False))
    for index, (frame, T_world_camera) in enumerate(zip(frames, POSES, strict=True)):
        assert not frame.depth.any() and np.array_equal(frame.color, color_of(index))
        assert frame.T_world_camera == pytest.approx(T_world_camera, abs=1e-9)
        assert frame.intrinsics.fx == pytest.approx(K[0])


@pytest.mark.parametrize("places", [["a.png"], ["images/a.jpg", "sparse/0/cameras.bin"]])
def test_images_alone_say_that_depth_is_missing(tmp_path: Path, places: list[str]) -> None:
    for place in places:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_bytes(b"x")
    what = "images of a COLMAP model" if len(places) > 1 else "images"
    for look in (open_source, describe):
        expect_refusal(f"depth is missing: {what} alone (1); describe colour", look, tmp_path)
