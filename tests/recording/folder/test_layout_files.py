"""Datasets that are one file of many images, and scenes in MVSNet's text form as its users differ."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.formats.image_file import write_pfm
from splatctrl_cli.geometry import transform_points
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.source import SourceOptions, describe, open_logs, open_source
from splatctrl_cli.records import Float64
from tests.recording.folder.make_layout import (
    GIVEN,
    HEIGHT,
    POSES,
    WIDTH,
    K,
    check,
    cloud_of,
    color_of,
    make_mvsnet,
    make_pcd,
    make_sens,
    pcd_bytes,
)
from tests.recording.log.make_log import frames_of
from tests.refused import expect_refusal

SENS = "scene0000_00.sens"


def test_a_sensor_file_is_read_by_itself_too_and_kept_as_it_is(tmp_path: Path) -> None:
    file = make_sens(tmp_path / "scene") / SENS
    check(frames_of(file))
    assert describe(file).kind == "ScanNet sensor file" and open_logs([file]) is None
    assert list(open_source(file).digests()) == [SENS]
    write_capture(tmp_path / "x.capture", open_source(file))
    check(frames_of(tmp_path / "x.capture"))
    (tmp_path / "scene" / "b.sens").write_bytes(file.read_bytes())
    expect_refusal("2 files .*.sens; give one of them, such as .*b.sens", open_source, tmp_path / "scene")
    frame = frames_of(make_sens(tmp_path / "jpeg", form=".jpg", is_packed=False))[1]
    assert np.abs(frame.color.astype(int) - color_of(1)).max() < 8
    assert frame.depth[3, 3] == np.float32(1370) * np.float32(1e-3)


def test_a_sensor_file_that_was_cut_gives_the_frames_before_and_counts_the_others(tmp_path: Path) -> None:
    source, said = open_source(make_sens(tmp_path, num_cut=40)), f"{SENS}: ends after 2 of 3 frames"
    assert (len(list(source.records())), source.loss.damaged, source.loss.notes) == (2, 1, [said])


def test_a_frame_whose_tracking_was_lost_or_whose_depth_does_not_unpack_is_counted(tmp_path: Path) -> None:
    file = make_sens(tmp_path) / SENS
    data = bytearray(file.read_bytes())
    pose = data.index(POSES[1].astype("<f4").tobytes())
    data[pose : pose + 64] = np.full(16, -np.inf, "<f4").tobytes()
    data[-20] ^= 0xFF  # in the last image of depth
    file.write_bytes(data)
    source, said = open_source(file), f"{SENS}#2: not an image that can be read"
    assert [frame.stamp_ns for frame in frames_of(source)] == [1_000_000_000]
    assert (source.loss.without_pose, source.loss.damaged, source.loss.notes[-1][-len(said) :]) == (1, 1, said)


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0, b"\x03", "expected a sensor file of version 4, got 3"),
        (12 + 15 + 256, b"\x00", r"expected colour as PNG or JPEG \(1, 2\).* got 0 and 1"),
        (12 + 15 + 260, b"\x02", r"depth as words, plain or zlib \(0, 1\), got 1 and 2"),
        (12 + 15 + 272, b"\xff\xff\xff\xff", "a size of depth"),
        (12 + 15 + 280, bytes(4), "expected counts per metre"),
    ],
)
def test_a_sensor_file_of_another_kind_is_refused(tmp_path: Path, at: int, value: bytes, words: str) -> None:
    file = make_sens(tmp_path) / SENS
    data = file.read_bytes()
    file.write_bytes(data[:at] + value + data[at + len(value) :])
    expect_refusal(words, open_source, file)


def write_clouds(folder: Path, names: Sequence[str], poses: Sequence[Float64] = (np.eye(4),) * 3) -> None:
    for index, (name, T) in enumerate(zip(names, poses, strict=False)):
        (folder / f"{name}.pcd").write_bytes(pcd_bytes(cloud_of(index), color_of(index), T))


@pytest.mark.parametrize(("form", "kind"), [("ascii", "U"), ("binary", "U"), ("binary_compressed", "F")])
def test_every_storage_of_a_cloud_gives_the_same_frames(tmp_path: Path, form: str, kind: str) -> None:
    source = open_source(make_pcd(tmp_path, form, kind))
    check(frames_of(source))
    assert source.loss.invalid_depth == 0  # NaN is how a cloud says that nothing was there
    said = ["intrinsics are those of the grid of cloud_8.pcd: fx 10.00, fy 11.00", "fields label are not used"]
    assert [note[: len(words)] for note, words in zip(source.loss.notes, said, strict=False)] == said
    if form == "binary_compressed":
        file = tmp_path / "cloud_10.pcd"
        file.write_bytes(file.read_bytes()[:-30])
        cut = open_source(tmp_path)
        assert (len(frames_of(cut)), cut.loss.damaged) == (2, 1), "one that does not unpack is counted"


def test_points_in_the_world_are_brought_into_the_camera_of_viewpoint(tmp_path: Path) -> None:
    for index, T in enumerate(POSES):
        points = transform_points(T, cloud_of(index)).astype(np.float32)
        (tmp_path / f"{index}.pcd").write_bytes(pcd_bytes(points, color_of(index), T))
    for index, frame in enumerate(frames_of(tmp_path)):
        assert frame.T_world_camera == pytest.approx(POSES[index], abs=1e-6)
        assert frame.depth == pytest.approx(np.nan_to_num(cloud_of(index)[..., 2]), abs=1e-5)
        assert frame.intrinsics.fx == pytest.approx(10.0, rel=1e-4)


def test_a_lone_cloud_without_viewpoint_is_its_own_world_and_that_is_said(tmp_path: Path) -> None:
    write_clouds(tmp_path, ["a"])
    source = open_source(tmp_path / "a.pcd")
    assert source.loss.notes[1].startswith("VIEWPOINT is the origin") and len(list(source.records())) == 1
    lens = SourceOptions(intrinsics={"camera": (10.0, 11.0, 4.0, 3.0, 0.1, 0.0, 0.0, 0.0)})
    said = "--intrinsics: expected FX,FY,CX,CY for a.pcd, got distortion"
    expect_refusal(said, open_source, tmp_path / "a.pcd", lens, error=UsageError)
    row = pcd_bytes(cloud_of(0).reshape(1, -1, 3), color_of(0).reshape(1, -1, 3), POSES[0])
    (tmp_path / "a.pcd").write_bytes(row)
    expect_refusal("a.pcd: not organised: 48 points in one row; record clouds", open_source, tmp_path)


def test_clouds_without_viewpoints_ask_for_poses_and_names_that_are_seconds_are_stamps(tmp_path: Path) -> None:
    names = [f"1285627014.8331{index}0319" for index in range(2)]
    write_clouds(tmp_path, names)
    said = "VIEWPOINT is the origin in all 2 clouds; write poses as VIEWPOINT, or give"
    expect_refusal(said, open_source, tmp_path)
    still = SourceOptions(camera_poses={"camera": (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)})
    assert frames_of(tmp_path, still)[1].T_world_camera[:3, 3].tolist() == [1.0, 2.0, 3.0]
    write_clouds(tmp_path, names, POSES)
    source = open_source(tmp_path)
    assert source.has_clock and frames_of(source)[1].stamp_ns == 1_285_627_014_833_110_319


def test_a_grid_that_is_no_pinhole_camera_is_refused_with_its_residual(tmp_path: Path) -> None:
    bent, turned = cloud_of(0), cloud_of(0)[:, ::-1].copy()
    bent[..., :2] *= 1 + 10 * np.linalg.norm(bent[..., :2] / bent[..., 2:], axis=2, keepdims=True) ** 2
    for points, said in (
        (bent, "the grid is not of a pinhole.*farther than 1.06 px"),
        (turned, "not of a pinhole camera"),
    ):
        (tmp_path / "a.pcd").write_bytes(pcd_bytes(points, color_of(0), POSES[0]))
        expect_refusal(f"a.pcd: .*{said}", open_source, tmp_path / "a.pcd")


def test_a_cloud_of_another_camera_than_the_first_and_wrong_intrinsics_are_refused(tmp_path: Path) -> None:
    folder = make_pcd(tmp_path)
    wide = cloud_of(1) * np.array([1.3, 1.3, 1.0], np.float32)
    (folder / "cloud_9.pcd").write_bytes(pcd_bytes(wide, color_of(1), POSES[1]))
    expect_refusal(r"cloud_9.pcd: the grid is not that of cloud_8.pcd", frames_of, folder)
    other = SourceOptions(intrinsics={"camera": (20.0, 11.0, 3.5, 2.5)})
    expect_refusal("the grid is not that of --intrinsics", open_source, folder, other)
    assert open_source(folder, GIVEN).cameras == ("camera",)


def test_a_cloud_without_colour_or_with_fewer_points_than_it_says_is_refused(tmp_path: Path) -> None:
    whole = pcd_bytes(cloud_of(0), color_of(0), POSES[0])
    cases = {
        "no colour: expected a field rgb or rgba, got x y z mono label": whole.replace(b"z rgb", b"z mono"),
        "not a PCD that can be read": whole[:-8],
        f"9999 points of {WIDTH}x{HEIGHT}": whole.replace(b"POINTS 48", b"POINTS 9999"),
        "expected a quaternion": whole.replace(b"VIEWPOINT", b"VIEWPOINT 0 0 0 0 0 0 0\n#"),
    }
    for words, data in cases.items():
        (tmp_path / "a.pcd").write_bytes(data)
        expect_refusal(words, open_source, tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("unit", "tail", "depth_scale"), [(1e-3, "425 2.5 192 933.8", None), (0.1, "0.5 0.01 192 2.5", 0.1)]
)
def test_lengths_that_can_be_no_metres_are_millimetres_or_as_a_scale_says(
    tmp_path: Path, unit: float, tail: str, depth_scale: float | None
) -> None:
    source = open_source(make_mvsnet(tmp_path, unit=unit, tail=tail), SourceOptions(depth_scale=depth_scale))
    metres = open_source(make_mvsnet(tmp_path / "m"))
    for frame, same in zip(frames_of(source), frames_of(metres), strict=True):
        assert frame.T_world_camera == pytest.approx(same.T_world_camera, abs=1e-9)
        assert frame.depth == pytest.approx(same.depth, rel=1e-6)
    said = [] if depth_scale else ["lengths are taken as millimetres, by a least depth of 425"]
    assert [note[: len(said[0])] for note in source.loss.notes] == said
    assert "lengths are taken as metres, by a least depth of 0.5" in metres.loss.notes[0]


def test_a_cut_depth_map_is_counted_and_a_centre_that_fits_no_image_refused(tmp_path: Path) -> None:
    folder = make_mvsnet(tmp_path)
    file, camera = folder / "depths/00000001_init.pfm", folder / "cams/00000002_cam.txt"
    file.write_bytes(file.read_bytes()[:-4])
    source = open_source(folder)
    assert (len(list(source.records())), source.loss.damaged) == (2, 1)
    camera.write_text(camera.read_text().replace(" 3.5\n", " 31.5\n"))
    expect_refusal("00000002_cam.txt: principal point (31.5, 2.5) fits no image of 8x6", open_source, folder)


@pytest.mark.parametrize("tail", ["0.5 0.01", "0.5 2.5", "0.5 0.01 192", "0.5 0.01 192 2.41", ""])
@pytest.mark.parametrize("images", ["images", "blended_images", "."])
def test_every_end_of_a_camera_file_and_place_of_images_is_read(tmp_path: Path, tail: str, images: str) -> None:
    folder = make_mvsnet(tmp_path, tail=tail, images=images)
    cv2.imwrite(str(folder / images / "00000000_masked.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    check(frames_of(folder))


def test_cameras_of_a_quarter_of_the_image_and_depth_of_another_size_are_fitted(tmp_path: Path) -> None:
    folder = make_mvsnet(tmp_path)
    for index in range(3):
        large = cv2.resize(color_of(index)[..., ::-1], (4 * WIDTH, 4 * HEIGHT), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / f"images/{index:08d}.png"), large)
    frame = frames_of(folder)[1]
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (4 * K[0], 4 * K[2])
    assert (frame.depth.shape, frame.depth[5, 6]) == ((4 * HEIGHT, 4 * WIDTH), np.float32(1.1 + 0.01 * (WIDTH + 1)))


def test_measured_depth_comes_before_that_of_a_network(tmp_path: Path) -> None:
    folder = make_mvsnet(tmp_path, depth="rendered_depth_maps")
    (folder / "depth_est").mkdir()
    for index in range(3):
        write_pfm(folder / f"depth_est/{index:08d}.pfm", np.full((HEIGHT, WIDTH), 7.0, np.float32))
    source = open_source(folder)
    check(frames_of(source))
    assert "depth is that of rendered_depth_maps/, not of depth_est" in source.loss.notes
