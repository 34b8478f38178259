"""Datasets as they are published: forms of a layout, and what each says of its cameras."""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.geometry import back_project, invert_transform, look_at, project, transform_points
from splatctrl_cli.recording.folder import layout_nerfstudio
from splatctrl_cli.recording.folder.layout_scenes import COLOR_LENS, DEPTH_LENS, T_COLOR_DEPTH
from splatctrl_cli.recording.folder.layout_tum import marker_to_camera
from splatctrl_cli.recording.folder.poses import stamp_of_text
from splatctrl_cli.recording.source import SourceOptions, open_source
from splatctrl_cli.records import Intrinsics
from tests.recording.folder.make_layout import (
    GIVEN,
    HEIGHT,
    POSES,
    WIDTH,
    K,
    changed_json,
    check,
    counts_of,
    make_arkit,
    make_bop,
    make_frames,
    make_icl,
    make_nerfstudio,
    make_redwood,
    make_replica,
    make_scannet,
    make_tum,
    matrix_text,
)
from tests.recording.log.make_log import frames_of
from tests.refused import expect_refusal

DOCS = Path(__file__).parents[3] / "docs"


def write_info(folder: Path) -> Path:
    """As sensorData.h writes it."""
    (folder / "info.txt").write_text("m_depthShift = 1000\n")
    return folder


@pytest.mark.parametrize("name", ["rgbd_dataset_freiburg3_x", "fr3_office", "renamed"])
def test_a_tum_camera_is_known_by_the_folder_or_by_the_heads_of_its_lists(tmp_path: Path, name: str) -> None:
    folder = make_tum(tmp_path / name)
    head = "# color images\n# file: 'rgbd_dataset_freiburg3_long_office_household.bag'\n"
    (folder / "rgb.txt").write_text(head + (folder / "rgb.txt").read_text())
    k = frames_of(folder)[0].intrinsics
    assert (k.fx, k.cx, k.cy) == (535.4, 320.1, 247.6)
    (folder / "calibration.txt").write_text("{} {} {} {}\n".format(*K))  # as ETH3D's sequences have it
    check(frames_of(folder), 1 / 5000)
    said = r"expected calibration.txt, or a name with.*give --intrinsics camera="
    expect_refusal(said, open_source, make_tum(tmp_path / "desk"))


def test_poses_of_bonn_are_moved_from_the_markers_to_the_camera(tmp_path: Path) -> None:
    source = open_source(make_tum(tmp_path / "rgbd_bonn_balloon"), GIVEN)
    assert frames_of(source)[1].T_world_camera == pytest.approx(marker_to_camera(POSES[1]), abs=1e-9)
    assert "without the scale of 1.059" in source.loss.notes[0]
    T_m = invert_transform(marker_to_camera(np.eye(4)))  # T_ros cancels around the identity
    assert T_m[:3, :3] @ T_m[:3, :3].T == pytest.approx(np.eye(3))
    assert invert_transform(T_m)[:3, 0] * 1.0593 == pytest.approx([1.0157, 0.0009, -0.3009], abs=1e-4)
    assert invert_transform(T_m)[:3, 3] == pytest.approx([0.0113, -0.0098, 0.0111])


DESCRIBED: dict[str, tuple[Callable[[Path], Path], float]] = {  # by the example's name: a folder, its unit of depth
    "replica_nice_slam": (make_replica, 1 / 6553.5),
    "replica_semantic_nerf": (lambda folder: make_replica(folder, is_slam=False), 1e-3),
    "icl_nuim": (make_icl, 1 / 5000),
    "scannet": (make_scannet, 1e-3),
    "twelve_scenes": (lambda folder: write_info(make_frames(folder, "data")), 1e-3),
}


def described(folder: Path, name: str) -> Path:
    """An example with the size and the lens of our images."""
    text = (DOCS / f"examples/{name}.toml").read_text().replace(".jpg", ".png")
    for key, value in zip(("width", "height", "fx", "fy", "cx", "cy"), (WIDTH, HEIGHT, *K), strict=True):
        text = re.sub(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
    (folder / "own.toml").write_text(text)
    return folder / "own.toml"


@pytest.mark.parametrize("name", DESCRIBED)
def test_a_layout_is_read_by_the_description_that_its_refusal_names(tmp_path: Path, name: str) -> None:
    make, unit = DESCRIBED[name]
    folder = make(tmp_path / name)
    expect_refusal(f"write .*{name}.toml .`splatctrl help {name}` prints it.*--root {folder}", open_source, folder)
    source = open_source(described(tmp_path, name), SourceOptions(root=folder))
    check(frames_of(source), unit)
    assert source.loss.without_pose == (name == "icl_nuim")  # image 0


def test_the_page_names_each_example() -> None:
    page = (DOCS / "input.md").read_text()
    assert [name for name in DESCRIBED if f"`{name}.toml`" not in page] == []


def test_a_point_of_icl_nuim_is_where_its_negative_focal_length_says(tmp_path: Path) -> None:
    frame = frames_of(described(tmp_path, "icl_nuim"), SourceOptions(root=make_icl(tmp_path / "icl")))[0]
    v, u, mirror = 1, 2, np.diag([1.0, -1.0, 1.0, 1.0])
    left = frame.depth[v, u] * np.array([(u - K[2]) / K[0], (v - K[3]) / -K[1], 1.0])  # the page's own camera
    world_left = transform_points(mirror @ POSES[0] @ mirror, left[None])[0]
    ours = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[v, u][None])[0]
    assert ours * [1, -1, 1] == pytest.approx(world_left, abs=1e-6)


def test_a_pose_of_a_description_that_is_not_finite_is_none(tmp_path: Path) -> None:
    folder = make_replica(tmp_path / "replica")
    lines = (folder / "traj.txt").read_text().splitlines()
    (folder / "traj.txt").write_text("\n".join([*lines[:-1], " ".join(["-inf"] * 12)]))
    source = open_source(described(tmp_path, "replica_nice_slam"), SourceOptions(root=folder))
    assert (len(list(source.records())), source.loss.without_pose) == (2, 1)


def test_smaller_depth_of_arkit_scenes_is_fitted_to_colour(tmp_path: Path) -> None:
    folder = make_arkit(tmp_path)
    for index, path in enumerate(sorted(folder.glob("*/lowres_depth/*"))):
        cv2.imwrite(str(path), counts_of(index)[::2, ::2])
    assert np.array_equal([frame.depth for frame in frames_of(folder)], [enlarged(index) for index in range(3)])


def enlarged(index: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Depth of a frame that was recorded at half the size."""
    nearest = cv2.resize(counts_of(index)[::2, ::2], (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    return nearest.astype(np.float32) * np.float32(1e-3)


def test_seven_scenes_register_depth_and_its_poses_to_colour(tmp_path: Path) -> None:
    """A plane of the depth image is the same plane in the world, and lies where the colour camera sees it."""
    stem, pose = tmp_path / "seq-01/frame-000000", look_at([0.5, 0.2, 1.0], [0.0, 0.0, 0.0])
    stem.parent.mkdir()
    cv2.imwrite(f"{stem}.color.png", np.full((480, 640, 3), 90, np.uint8))
    depth = np.full((480, 640), 65535, np.uint16)
    depth[100:400, 100:500] = 2000
    cv2.imwrite(f"{stem}.depth.png", depth)
    Path(f"{stem}.pose.txt").write_text(matrix_text(pose))
    source = open_source(tmp_path)
    frame = frames_of(source)[0]
    own = Intrinsics(**dict(zip(("fx", "fy", "cx", "cy"), DEPTH_LENS, strict=True)), width=640, height=480)
    metres = np.where(depth == 65535, 0, depth).astype(np.float32) * np.float32(1e-3)
    corner = transform_points(pose, back_project(own, metres)[100, 100][None])
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (COLOR_LENS[0], COLOR_LENS[2])
    assert frame.T_world_camera == pytest.approx(pose @ invert_transform(T_COLOR_DEPTH), abs=1e-9)
    pixel = project(frame.intrinsics, transform_points(invert_transform(frame.T_world_camera), corner))[0]
    rows, columns = np.nonzero(frame.depth)
    assert np.array([columns.min(), rows.min()]) == pytest.approx(pixel, abs=2.0)
    points = back_project(frame.intrinsics, frame.depth)[frame.depth > 0]
    seen, normal = transform_points(frame.T_world_camera, points), pose[:3, 2]
    assert seen @ normal == pytest.approx(float((corner @ normal)[0]), abs=0.02)
    assert "registered to colour by another Kinect's" in source.loss.notes[0]


def test_a_pose_that_windows_writes_as_infinite_is_lost(tmp_path: Path) -> None:
    folder = make_frames(tmp_path, "data")
    (folder / "data/frame-000001.pose.txt").write_text("-1.#INF -1.#INF00 1.#QNAN -1.#IND\n" * 4)
    source = open_source(folder, GIVEN)
    assert (len(list(source.records())), source.loss.without_pose) == (2, 1)


def test_depth_in_a_pgm_is_read_as_sensreader_writes_it(tmp_path: Path) -> None:
    folder = make_frames(tmp_path, "sequence")
    head = b"P5\n# data values are 16-bit each; depth shift is 1000\n%d %d\n65535\n" % (WIDTH, HEIGHT)
    for index, path in enumerate(sorted(folder.glob("sequence/*.depth.png"))):
        path.unlink()
        path.with_suffix(".pgm").write_bytes(head + counts_of(index).astype(">u2").tobytes())
    check(frames_of(folder, GIVEN))


@pytest.mark.parametrize("trajectory", ["livingroom1-traj.txt", "lounge_trajectory.log", "scene/trajectory.log"])
def test_open3d_scenes_are_known_by_the_names_of_its_downloads(tmp_path: Path, trajectory: str) -> None:
    folder = make_redwood(tmp_path)
    (folder / "color").rename(folder / "colors")
    (folder / trajectory).parent.mkdir(exist_ok=True)
    (folder / "trajectory.log").rename(folder / trajectory)
    check(frames_of(folder))


def of_transforms(folder: Path, **changed: Any) -> Path:
    """make_nerfstudio with other values of the file; None takes a value out."""
    file = make_nerfstudio(folder) / "transforms.json"
    content = json.loads(file.read_text()) | changed
    file.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return folder


def test_transforms_of_instant_ngp_have_their_own_names(tmp_path: Path) -> None:
    """camera_angle_x for fl_x, no centre and size, depth_path, its unit in the file, names without suffix."""
    folder = make_nerfstudio(tmp_path)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    for entry in frames:
        entry |= {"depth_path": entry.pop("depth_file_path"), "file_path": entry["file_path"].removesuffix(".png")}
    short = {"camera_angle_x": 2 * math.atan(4 / 10.0), "fl_y": 11.0, "integer_depth_scale": 1e-3 / 2}
    (folder / "transforms.json").write_text(json.dumps({**short, "aabb_scale": 4, "frames": frames}))
    frame = frames_of(folder)[1]
    expected = Intrinsics(fx=10.0, fy=11.0, cx=3.5, cy=2.5, width=WIDTH, height=HEIGHT)
    assert vars(frame.intrinsics) == pytest.approx(vars(expected))
    assert frame.depth == pytest.approx(counts_of(1) * 0.5e-3, abs=1e-6)
    assert frame.T_world_camera == pytest.approx(POSES[1], abs=1e-12)
    scaled = frames_of(of_transforms(tmp_path / "scaled", applied_scale=0.5))[0]
    assert scaled.T_world_camera[:3, 3] == pytest.approx(POSES[0][:3, 3] / 0.5)


def test_masks_of_nerfstudio_leave_pixels_out(tmp_path: Path) -> None:
    folder = make_nerfstudio(tmp_path)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :3] = 0
    cv2.imwrite(str(folder / "mask.png"), mask)
    masked = {"mask_path": "mask.png"}
    changed_json(folder / "transforms.json", lambda content: [frame.update(masked) for frame in content["frames"]])
    source = open_source(folder)
    frame = frames_of(source)[0]
    assert np.array_equal(frame.valid, mask > 0) and np.array_equal(frame.depth > 0, mask > 0)
    assert "mask.png" in source.digests()
    (folder / "mask.png").write_bytes(b"no image")
    damaged = open_source(folder)
    assert not any(r.valid.any() for r in frames_of(damaged) if r.valid is not None)
    assert damaged.loss.damaged == 3


def test_depth_of_nerfstudio_may_be_smaller_or_float(tmp_path: Path) -> None:
    folder = make_nerfstudio(tmp_path)
    cv2.imwrite(str(folder / "depths/d_0.png"), counts_of(0)[::2, ::2])
    np.save(folder / "depths/d_1.npy", counts_of(1).astype(np.float32) + np.float32(0.25))
    text = (folder / "transforms.json").read_text().replace("depths/d_1.png", "depths/d_1.npy")
    (folder / "transforms.json").write_text(text)
    small, floats, _ = frames_of(folder)
    assert np.array_equal(small.depth, enlarged(0))
    assert floats.depth[1:] == pytest.approx((counts_of(1)[1:] + 0.25) * 1e-3, abs=1e-6)


@pytest.mark.parametrize(
    ("changed", "model"),
    [
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k2": 0.02, "k3": 0.03, "k4": 0.04}, "equidistant"),
        ({"camera_model": None, "is_fisheye": True, "k1": 0.01, "k2": 0.02, "k3": 0.03, "k4": 0.04}, "equidistant"),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.01}, "plumb_bob"),
    ],
)
def test_lens_models_of_nerfstudio_are_those_of_opencv(tmp_path: Path, changed: dict[str, Any], model: str) -> None:
    camera = layout_nerfstudio.read(of_transforms(tmp_path, **changed), SourceOptions()).listed[0].camera
    values = [value for key, value in changed.items() if key.startswith("k")]
    assert (camera.distortion_model, camera.distortion[: len(values)]) == (model, values)


UNIT = "depth of frame_0: expected metres per count, got .*give --depth-scale"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model: expected one of SIMPLE_PINHOLE.*got 'EQUIRECTANGULAR'"),
        ({"k4": 0.1}, "expected no k4, got 0.1"),
        ({"fl_x": None}, "no usable 'camera_angle_x' in the intrinsics"),
        ({"applied_scale": 0.0}, "expected numbers, got float division by zero"),
        *(({"integer_depth_scale": scale}, UNIT) for scale in (0.0, -0.001, math.nan, math.inf)),
    ],
)
def test_a_transforms_file_that_cannot_be_used_is_refused(
    tmp_path: Path, changed: dict[str, Any], message: str
) -> None:
    folder = of_transforms(tmp_path, **changed)
    expect_refusal(message, open_source, folder)
    assert message != UNIT or frames_of(folder, SourceOptions(depth_scale=1e-3))[0].depth[1, 1] > 1.0


def test_a_bop_scene_of_several_sensors_gives_a_camera_each(tmp_path: Path) -> None:
    for sensor in ("cam1", "photoneo"):
        for path in list(make_bop(tmp_path / sensor).iterdir()):
            path.rename(tmp_path / f"{path.stem}_{sensor}{path.suffix}")
        (tmp_path / sensor).rmdir()
    assert open_source(tmp_path).cameras == ("cam1", "photoneo")
    check(frames_of(tmp_path, SourceOptions(cameras=("photoneo",))), 1e-4)


def test_grey_tiff_images_of_bop_are_read(tmp_path: Path) -> None:
    folder = make_bop(tmp_path)
    (folder / "rgb").rename(folder / "gray")
    for path in sorted(folder.glob("*/*.png")):
        cv2.imwrite(str(path.with_suffix(".tif")), cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        path.unlink()
    check(frames_of(folder), 1e-4)


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        ("12.5e-6", 12_500),
        *((text, None) for text in ("1e300", "-99999999999999999999", "nan", "inf", "x")),
    ],
)
def test_a_stamp_keeps_every_nanosecond_that_is_written_and_is_none_without_a_time(
    text: str, stamp_ns: int | None
) -> None:
    assert stamp_of_text(text) == stamp_ns


@pytest.mark.parametrize("word", ["inf", "1e200"])
def test_a_pose_of_tum_that_is_none_is_named_by_its_line(tmp_path: Path, word: str) -> None:
    file = make_tum(tmp_path / "fr3_x") / "groundtruth.txt"
    file.write_text(f"{file.read_text()}1305031109.0 {word} 0 0 {word} 0 0 1\n")
    expect_refusal("groundtruth.txt:8: expected 'stamp tx ty tz qx qy qz qw'", open_source, file.parent)


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        ("inf 6 10 11 3.5 2.5", r"expected width, height, fx, fy, cx, cy, got .*copy the file again"),
        ("8 6 1e-320 11 3.5 2.5", "expected a positive number of pixels, got 1e-320"),
    ],
)
def test_a_lens_of_arkit_scenes_that_is_none_is_refused(tmp_path: Path, lens: str, said: str) -> None:
    folder = make_arkit(tmp_path)
    next((folder / "41069021_frames/lowres_wide_intrinsics").iterdir()).write_text(lens)
    expect_refusal(said, open_source, folder)
