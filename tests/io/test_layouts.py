"""Folders of public datasets, opened by their own files: small trees with a known pose and depth."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform, look_at, quat_from_rotation
from splatctrl_cli.io.capture_writer import write_capture
from splatctrl_cli.io.describe import describe
from splatctrl_cli.io.layouts import LAYOUTS, layout_of
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.poses import OPENGL_FROM_OPTICAL
from splatctrl_cli.io.source import open_source
from splatctrl_cli.records import Float64, RgbdFrame

WIDTH, HEIGHT = 8, 6
TEXTS = {".txt", ".json", ".log"}
POSES = [look_at([0.5 + 0.1 * index, 0.2, 1.0], [0.0, 0.0, 0.0]) for index in range(3)]
K = (10.0, 11.0, 3.5, 2.5)


def color_of(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """RGB of a frame: red says which."""
    image = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
    image[..., 0] = 50 + 10 * index
    return image


def counts_of(index: int, unit: float = 1e-3) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Depth counts of a frame: its number and each pixel tell in the value; the first pixel has none."""
    metres = 1.0 + 0.1 * index + 0.01 * np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    counts = np.round(metres / unit).astype(np.uint16)
    counts[0, 0] = 0
    return counts


def write_pair(color: Path, depth: Path, index: int, unit: float = 1e-3, invalid: int = 0) -> None:
    for path in (color, depth):
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(color), color_of(index)[..., ::-1])
    counts = counts_of(index, unit)
    counts[0, 0] = invalid
    cv2.imwrite(str(depth), counts)


def matrix_text(T: Float64) -> str:
    return "\n".join(" ".join(repr(float(v)) for v in row) for row in T) + "\n"


def frames_of(folder: Path, options: SourceOptions | None = None) -> list[RgbdFrame]:
    return [record for record in open_source(folder, options).records() if isinstance(record, RgbdFrame)]


def check(frames: list[RgbdFrame], unit: float = 1e-3, k: tuple[float, ...] = K) -> None:
    """Every value of three frames in order."""
    assert len(frames) == 3
    for index, frame in enumerate(frames):
        assert np.array_equal(frame.color, color_of(index))
        assert np.array_equal(frame.depth, counts_of(index, unit).astype(np.float32) * np.float32(unit))
        assert frame.depth[0, 0] == 0
        assert frame.T_world_camera == pytest.approx(POSES[index], abs=1e-12)
        i = frame.intrinsics
        assert (i.fx, i.fy, i.cx, i.cy, i.width, i.height) == (*k, WIDTH, HEIGHT)


def make_tum(folder: Path) -> Path:
    """Depth 5 ms after colour, poses half a period before and after, so that colour lies in their middle."""
    start = 1305031102.0
    listed: dict[str, list[str]] = {"rgb": ["# timestamp filename"], "depth": []}
    poses = []
    for index, T in enumerate(POSES):
        color, depth = f"{start + index * 0.1:.6f}", f"{start + index * 0.1 + 0.005:.6f}"
        write_pair(folder / f"rgb/{color}.png", folder / f"depth/{depth}.png", index, 1 / 5000)
        listed["rgb"].append(f"{color} rgb/{color}.png")
        listed["depth"].append(f"{depth} depth/{depth}.png")
        quat = quat_from_rotation(T[:3, :3])
        for step in (-0.05, 0.05):
            position = T[:3, 3] + step * np.array([1.0, 2.0, 0.0])
            poses.append([start + index * 0.1 + step * 0.5, *position, *quat])
    for name, lines in listed.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{row[0]:.6f} " + " ".join(repr(float(v)) for v in row[1:]) for row in poses]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    return folder


def make_redwood(folder: Path) -> Path:
    lines = []
    for index, T in enumerate(POSES):
        write_pair(folder / f"color/{index + 9}.png", folder / f"depth/{index + 9}.png", index)
        lines.append(f"{index} {index} {index + 1}\n{matrix_text(T)}")
    (folder / "trajectory.log").write_text("".join(lines))
    by_columns = [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1]
    text = json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": by_columns})
    (folder / "camera_intrinsic.json").write_text(text)
    return folder


def make_frames(folder: Path, sequence: str = "seq-01") -> Path:
    for index, T in enumerate(POSES):
        stem = folder / sequence / f"frame-{index:06d}"
        write_pair(Path(f"{stem}.color.png"), Path(f"{stem}.depth.png"), index, invalid=65535)
        Path(f"{stem}.pose.txt").write_text(matrix_text(T))
    return folder


def make_scannet(folder: Path, depth_size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    for index, T in enumerate(POSES):
        name = 8 + index  # 8, 9, 10: by number, not by letter
        write_pair(folder / f"color/{name}.png", folder / f"depth/{name}.png", index)
        if depth_size != (WIDTH, HEIGHT):
            cv2.imwrite(str(folder / f"depth/{name}.png"), np.full(depth_size[::-1], 1500, np.uint16))
        (folder / "pose").mkdir(exist_ok=True)
        (folder / f"pose/{name}.txt").write_text(matrix_text(T))
    (folder / "intrinsic").mkdir()
    for name, scale in (("color", 1.0), ("depth", depth_size[0] / WIDTH)):
        matrix = np.eye(4)
        matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = (scale * value for value in K)
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text(matrix_text(matrix))
        (folder / f"intrinsic/extrinsic_{name}.txt").write_text(matrix_text(np.eye(4)))
    return folder


def make_bop(folder: Path, with_poses: bool = True) -> Path:
    cameras = {}
    for index, T in enumerate(POSES):
        write_pair(folder / f"rgb/{index:06d}.png", folder / f"depth/{index:06d}.png", index, 1e-4)
        entry: dict[str, Any] = {"cam_K": [K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1], "depth_scale": 0.1}
        if with_poses:
            inverse = invert_transform(T)
            entry |= {"cam_R_w2c": inverse[:3, :3].ravel().tolist(), "cam_t_w2c": (1e3 * inverse[:3, 3]).tolist()}
        cameras[str(index)] = entry
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def make_nerfstudio(folder: Path, **of_second: float) -> Path:
    frames: list[dict[str, Any]] = []
    for index, T in enumerate(POSES):
        write_pair(folder / f"images/frame_{index}.png", folder / f"depths/d_{index}.png", index)
        frames.append(
            {
                "file_path": f"./images/frame_{index}.png",
                "depth_file_path": f"depths/d_{index}.png",
                "transform_matrix": (T @ OPENGL_FROM_OPTICAL).tolist(),
            }
        )
    frames[1] |= of_second
    lens = {"fl_x": K[0], "fl_y": K[1], "cx": K[2] + 0.5, "cy": K[3] + 0.5, "w": WIDTH, "h": HEIGHT}
    content = {"camera_model": "OPENCV", **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


INTRINSICS = SourceOptions(intrinsics={"camera": K})


def test_a_tum_folder_is_paired_by_stamp_and_posed_between_its_samples(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "rgbd_dataset_freiburg3_x")
    source = open_source(folder, INTRINSICS)
    frames = [record for record in source.records() if isinstance(record, RgbdFrame)]
    check(frames, 1 / 5000)
    assert source.has_clock
    assert [frame.stamp_ns for frame in frames] == [1_305_031_102_000_000_000 + i * 100_000_000 for i in range(3)]


def test_the_camera_of_a_tum_folder_is_known_by_its_name(tmp_path: Path) -> None:
    frame = frames_of(make_tum(tmp_path / "rgbd_dataset_freiburg3_x"))[0]
    assert (frame.intrinsics.fx, frame.intrinsics.cy) == (535.4, 247.6)
    assert np.array_equal(frame.color, color_of(0))  # no distortion
    with pytest.raises(InputError, match=r"expected a name with one of freiburg1.*give --intrinsics camera="):
        open_source(make_tum(tmp_path / "desk"))


def test_tum_images_without_partner_or_pose_are_counted(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "freiburg3")
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[1:]) + "\n")
    rows = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(rows[:5]) + "\n")
    source = open_source(folder, INTRINSICS)
    assert len(list(source.records())) == 1
    assert (source.loss.unpaired_color, source.loss.unpaired_depth, source.loss.without_pose) == (1, 0, 1)


def test_an_open3d_scene_goes_by_place_where_there_are_as_many_poses(tmp_path: Path) -> None:
    check(frames_of(make_redwood(tmp_path)))


def test_an_open3d_scene_goes_by_number_where_there_are_more_poses(tmp_path: Path) -> None:
    folder = make_redwood(tmp_path)
    text = (folder / "trajectory.log").read_text()
    for index in range(3):
        text = text.replace(f"{index} {index} {index + 1}\n", f"{index + 9} {index + 9} {index + 10}\n")
    (folder / "trajectory.log").write_text(f"0 0 1\n{matrix_text(np.eye(4))}" + text)
    check(frames_of(folder))


def test_an_open3d_scene_without_intrinsics_asks_for_them(tmp_path: Path) -> None:
    folder = make_redwood(tmp_path / "scene")
    (folder / "camera_intrinsic.json").unlink()
    with pytest.raises(InputError, match=r"no camera_intrinsic.json in it or above it; give --intrinsics"):
        open_source(folder)
    check(frames_of(folder, INTRINSICS))


@pytest.mark.parametrize("sequence", ["seq-01", ""])
def test_seven_scenes_take_65535_for_no_depth(tmp_path: Path, sequence: str) -> None:
    source = open_source(make_frames(tmp_path, sequence))
    check([r for r in source.records() if isinstance(r, RgbdFrame)], k=(585.0, 585.0, 320.0, 240.0))
    assert "7-Scenes' default 585, 585, 320, 240 is taken" in source.loss.notes[0]
    assert not source.has_clock


def test_frames_with_their_own_intrinsics_need_no_default(tmp_path: Path) -> None:
    folder = make_frames(tmp_path)
    matrix = [[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]
    (folder / "camera-intrinsics.txt").write_text("\n".join(" ".join(map(str, row)) for row in matrix))
    source = open_source(folder)
    check([r for r in source.records() if isinstance(r, RgbdFrame)])
    assert source.loss.notes == []


def test_a_scannet_export_is_read_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    check(frames_of(make_scannet(tmp_path)))


def test_a_lost_pose_of_scannet_is_counted_not_refused(tmp_path: Path) -> None:
    folder = make_scannet(tmp_path)
    (folder / "pose/9.txt").write_text(matrix_text(np.full((4, 4), -np.inf)))
    source = open_source(folder)
    assert [int(r.color[0, 0, 0]) for r in source.records() if isinstance(r, RgbdFrame)] == [50, 70]
    assert source.loss.without_pose == 1


def test_scannet_depth_of_another_size_is_registered_to_colour(tmp_path: Path) -> None:
    frame = frames_of(make_scannet(tmp_path, (WIDTH // 2, HEIGHT // 2)))[0]
    assert frame.depth.shape == (HEIGHT, WIDTH)
    assert frame.depth[1:-1, 1:-1] == pytest.approx(1.5)


def test_a_scannet_extrinsic_that_is_a_transform_is_refused(tmp_path: Path) -> None:
    folder = make_scannet(tmp_path)
    (folder / "intrinsic/extrinsic_depth.txt").write_text(matrix_text(POSES[0]))
    with pytest.raises(InputError, match=r"extrinsic_depth.txt: expected the identity"):
        open_source(folder)


def test_a_bop_scene_has_poses_in_millimetres_and_a_depth_unit_of_its_own(tmp_path: Path) -> None:
    check(frames_of(make_bop(tmp_path)), 1e-4)


def test_a_bop_scene_without_poses_needs_a_camera_that_stands_still(tmp_path: Path) -> None:
    folder = make_bop(tmp_path, with_poses=False)
    with pytest.raises(InputError, match=r"scene_camera.json has no pose for any image.*give --camera-pose"):
        open_source(folder)
    still = SourceOptions(camera_poses={"camera": (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)})
    assert [frame.T_world_camera[:3, 3].tolist() for frame in frames_of(folder, still)] == [[1.0, 2.0, 3.0]] * 3
    assert "camera camera: stands still where --camera-pose puts it" in open_source(folder, still).loss.notes[0]


def test_a_nerfstudio_folder_needs_no_description(tmp_path: Path) -> None:
    check(frames_of(make_nerfstudio(tmp_path)))


def test_frames_with_a_lens_of_their_own_become_a_camera_of_their_own(tmp_path: Path) -> None:
    frames = frames_of(make_nerfstudio(tmp_path, fl_x=20.0))
    assert [(frame.camera, frame.intrinsics.fx) for frame in frames] == [
        ("camera", 10.0),
        ("camera-1", 20.0),
        ("camera", 10.0),
    ]


def test_a_capture_refuses_a_camera_that_changes_its_lens(tmp_path: Path) -> None:
    folder = make_nerfstudio(tmp_path, fl_x=20.0)
    (tmp_path / "out").mkdir()
    write_capture(tmp_path / "out", open_source(folder))
    with pytest.raises(InputError, match="camera holdout changes its lens"):
        write_capture(tmp_path / "again", open_source(folder, SourceOptions(holdout=("0", "1"))))


def test_a_nerfstudio_frame_without_depth_is_named(tmp_path: Path) -> None:
    folder = make_nerfstudio(tmp_path)
    content = json.loads((folder / "transforms.json").read_text())
    del content["frames"][2]["depth_file_path"]
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"frame_2.png: depth_file_path is missing"):
        open_source(folder)


def test_each_layout_is_known_by_its_files_and_described(tmp_path: Path) -> None:
    makers = (make_tum, make_bop, make_scannet, make_frames, make_nerfstudio, make_redwood)
    for layout, make in zip(LAYOUTS, makers, strict=True):
        folder = make(tmp_path / f"{make.__name__}_freiburg3")
        found = layout_of(folder)
        assert found is not None and found.name == layout.name
        summary = describe(folder)
        assert (summary.kind, summary.grids[0].rows) == (layout.name, [["camera", 3]])


def test_files_that_are_named_but_not_there_are_counted(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "freiburg3")
    next((folder / "depth").iterdir()).unlink()
    source = open_source(folder, INTRINSICS)
    assert len(list(source.records())) == 2
    assert (source.loss.unpaired_color, source.loss.unpaired_depth) == (1, 0)
    assert "1 of 3 views lack a file" in source.loss.notes[0]
    (folder / "rgb").rename(tmp_path / "rgb")
    (folder / "rgb.txt").write_text((folder / "rgb.txt").read_text().replace("rgb/", "../rgb/"))
    with pytest.raises(InputError, match="is not in"):
        open_source(folder, INTRINSICS)


@pytest.mark.parametrize("make", [make_tum, make_bop, make_scannet, make_frames, make_nerfstudio, make_redwood])
@pytest.mark.parametrize(
    "content", [b"", b"{}", b"[]", b"null", b"1 2 3\n", b"\xff\xfe nonsense \x00", b'{"0": 3, "frames": [1]}']
)
def test_a_damaged_text_of_a_layout_is_refused_in_one_line_or_read_around(
    tmp_path: Path, make: Callable[[Path], Path], content: bytes
) -> None:
    names = [p.relative_to(tmp_path / "whole") for p in make(tmp_path / "whole").rglob("*") if p.suffix in TEXTS]
    assert names
    for number, name in enumerate(names):
        folder = make(tmp_path / f"freiburg3_{number}")
        (folder / name).write_bytes(content)
        try:
            source = open_source(folder, SourceOptions())
            list(source.records())
        except InputError as error:
            assert "\n" not in str(error) and error.remedy


def test_a_name_that_no_camera_has_is_refused(tmp_path: Path) -> None:
    folder = make_redwood(tmp_path)
    with pytest.raises(InputError, match="no camera 'cam0'; use one of: camera"):
        open_source(folder, SourceOptions(camera_poses={"cam0": (0, 0, 0, 0, 0, 0, 1)}))
    with pytest.raises(InputError, match="--intrinsics does not apply to a BOP scene"):
        open_source(make_bop(tmp_path / "bop"), INTRINSICS)


def test_frames_can_be_held_out_of_a_layout(tmp_path: Path) -> None:
    frames = frames_of(make_bop(tmp_path), SourceOptions(holdout=("1",)))
    assert [frame.camera for frame in frames] == ["camera", "holdout", "camera"]


def test_a_real_open3d_scene_opens_by_its_folder(real_data: Path) -> None:
    frames = frames_of(real_data / "open3d_rgbd/RGBD")
    assert len(frames) == 5
    assert (frames[0].intrinsics.fx, frames[0].intrinsics.cx) == (525.0, 319.5)


def test_a_real_nerfstudio_folder_opens_by_itself(real_data: Path) -> None:
    frames = frames_of(real_data / "tabletop_views", SourceOptions(depth_scale=1e-4))
    assert len(frames) == 12
    assert (frames[0].intrinsics.fx, frames[0].intrinsics.cx) == (288.0, 159.5)
