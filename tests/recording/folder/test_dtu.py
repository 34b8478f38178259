"""DTU scans in MVSNet's and IDR's layouts: what is written reads back, damage is named, views become records."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.protocols import score_protocol
from splatctrl_cli.formats.image_file import write_pfm
from splatctrl_cli.geometry import invert_transform, look_at, project
from splatctrl_cli.recording.folder.dtu import DtuView, read_dtu, write_dtu
from splatctrl_cli.recording.folder.idr import (
    DtuSource,
    decompose,
    projection,
    read_idr,
    shrink_view,
    view_numbers,
    write_idr,
)
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import Intrinsics
from tests.recording.log.make_log import frames_of
from tests.refused import expect_refusal

K = Intrinsics(fx=61.0, fy=62.0, cx=32.5, cy=23.0, width=64, height=48)

IMAGES, DEPTHS = "Rectified/scan7_train", "Depths_raw/scan7"

Damage = Callable[[Path], object]


def view(number: int) -> DtuView:
    rng = np.random.default_rng(number)
    depth = rng.uniform(0.5, 1.5, (48, 64)).astype(np.float32)
    depth[:5] = 0
    mask = np.zeros((48, 64), np.bool_)
    mask[10:30, 20 + number : 50] = True
    return DtuView(
        name=f"{number:06d}",
        color=rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
        depth=depth,
        intrinsics=K,
        T_world_camera=look_at([1.0, 0.2 * number, 0.5], [0.0, 0.0, 0.0]),
        mask=mask,
    )


VIEWS = [view(number) for number in range(4)]


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """The root of a scan in MVSNet's layout."""
    write_dtu(tmp_path / "dtu", "scan7", VIEWS)
    return tmp_path / "dtu"


@pytest.fixture
def idr(tmp_path: Path) -> Path:
    """The folder of a scan in IDR's layout, in a root of its own."""
    return write_idr(tmp_path / "idr", "scan7", VIEWS)


def places(source: DtuSource) -> list[tuple[str, int]]:
    return [(frame.camera, frame.stamp_ns) for frame in frames_of(source)]


def remove(folder: Path, pattern: str = "*") -> None:
    for path in folder.glob(pattern):
        path.unlink()


@pytest.mark.parametrize("layout", ["MVSNet", "IDR"])
def test_a_written_scan_reads_back(scan: Path, idr: Path, layout: str) -> None:
    root, read = (scan, read_dtu) if layout == "MVSNet" else (idr.parent, read_idr)
    found = read(root)
    assert (found.name, found.numbers, found.without_depth) == ("scan7", (0, 1, 2, 3), ())
    for one, original in zip(found.views, VIEWS, strict=True):
        np.testing.assert_array_equal(one.color, original.color)
        np.testing.assert_allclose(one.depth, original.depth, rtol=2e-7)
        np.testing.assert_allclose(one.T_world_camera, original.T_world_camera, atol=1e-8)
        assert vars(one.intrinsics) == {name: pytest.approx(value, abs=1e-6) for name, value in vars(K).items()}
        assert layout == "MVSNet" or np.array_equal(one.mask, original.mask)
    source = DtuSource(root)
    assert (source.layout, source.has_clock, source.joint_names, source.cameras) == (layout, False, (), ("camera",))
    assert len(source.digests()) == (16 if layout == "MVSNet" else 13), "camera, image, depth, what it shows, or mask"
    assert read(root, "scan7").name == "scan7"
    expect_refusal("no scan 'scan9'; give --scan, one of: scan7", read, root, "scan9")
    for folder in (scan, idr):
        expect_refusal(r"a DTU data set, .*; give it as --dtu \(in a suite dtu = ", open_source, folder)


def test_camera_files_hold_world_to_camera_in_millimetres_and_pairs_the_nearest_first(scan: Path) -> None:
    words = (scan / "Cameras/00000001_cam.txt").read_text().split()
    extrinsic = np.array(words[1:17], dtype=float).reshape(4, 4)
    expected = invert_transform(VIEWS[1].T_world_camera)
    np.testing.assert_allclose(extrinsic[:3, :3], expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(extrinsic[:3, 3], expected[:3, 3] * 1000, atol=1e-5)
    num, *lines = (scan / "Cameras/pair.txt").read_text().splitlines()
    assert (num, ["".join(line.split()[1::2]) for line in lines[1::2]]) == ("4", ["123", "023", "130", "210"])


FULL = np.array([[2892.3, 0, 823.2], [0, 2883.2, 619.1], [0, 0, 1]])

FULL_DEPTH = (np.arange(1600 * 1200, dtype=np.float32) % 4099).reshape(1200, 1600) + 100


def resized(root: Path, size: tuple[int, int], camera: str, matrix: np.ndarray, depth: np.ndarray) -> DtuView:
    """View 0 of a scan with another image size, camera file and depth map, as DTU's variants have."""
    remove(root / IMAGES)
    image = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    cv2.imwrite(str(root / IMAGES / "rect_001_3_r5000.png"), image)
    text = (root / "Cameras/00000000_cam.txt").read_text().split("intrinsic")[0]
    rows = "\n".join(" ".join(str(value) for value in row) for row in matrix)
    (root / "Cameras" / camera).parent.mkdir(exist_ok=True)
    (root / "Cameras" / camera).write_text(f"{text}intrinsic\n{rows}\n\n425.0 2.5\n")
    write_pfm(root / DEPTHS / "depth_map_0000.pfm", depth)
    (root / DEPTHS / "depth_visual_0000.png").unlink()
    return read_dtu(root).views[0]


def test_training_cameras_are_for_a_quarter_of_the_image(scan: Path) -> None:
    quarter = np.array([[361.5, 0, 82.9], [0, 360.4, 66.4], [0, 0, 1]])
    found = resized(scan, (640, 512), "train/00000000_cam.txt", quarter, np.full((128, 160), 700, np.float32))
    k = found.intrinsics
    assert (k.fx, k.cx, k.cy) == pytest.approx((1446.0, 331.6, 265.6))
    assert np.count_nonzero(found.depth) == 128 * 160
    np.testing.assert_allclose(found.depth[::4, ::4], 0.7)


def test_pixels_that_are_hidden_or_not_finite_have_no_depth_and_light_three_is_taken(scan: Path) -> None:
    shown, depth = np.full((48, 64), 255, np.uint8), np.full((48, 64), 700, np.float32)
    shown[20:30, 20:30] = 0
    cv2.imwrite(str(scan / DEPTHS / "depth_visual_0001.png"), shown)
    depth[0, :3] = np.nan, np.inf, -5
    write_pfm(scan / DEPTHS / "depth_map_0000.pfm", depth)
    (scan / DEPTHS / "depth_visual_0000.png").unlink()
    for light in (0, 6):
        cv2.imwrite(str(scan / IMAGES / f"rect_001_{light}_r5000.png"), np.zeros((48, 64, 3), np.uint8))
    views = read_dtu(scan).views
    np.testing.assert_allclose(views[0].depth[0, :4], [0, 0, 0, 0.7])
    assert (views[1].depth[20:30, 20:30] == 0).all() and (views[1].depth[31:] > 0).all()
    assert views[0].name == "rect_001_3_r5000"


def test_full_cameras_and_depth_are_halved_and_cropped(scan: Path) -> None:
    found = resized(scan, (640, 512), "00000000_cam.txt", FULL, FULL_DEPTH)
    k = found.intrinsics
    assert (k.fx, k.cx, k.cy) == pytest.approx((1446.15, 331.6, 265.55))
    np.testing.assert_allclose(found.depth * 1000, FULL_DEPTH[88 : 88 + 1024 : 2, 160 : 160 + 1280 : 2], rtol=1e-6)


def test_cameras_and_depth_of_the_full_size_fit_images_made_smaller(scan: Path) -> None:
    """A patch of 4x4 pixels of the full image is one pixel of the small one; its middle stays where it was."""
    found = resized(scan, (400, 300), "00000000_cam.txt", FULL, FULL_DEPTH)
    middle = np.array([[4 * 30 + 1.5, 4 * 20 + 1.5]])
    point = np.column_stack([(middle - FULL[:2, 2]) / np.diag(FULL)[:2], [1.0]])
    np.testing.assert_allclose(project(found.intrinsics, point), [[30.0, 20.0]], atol=1e-9)
    at_full_size = replace(
        found,
        color=np.zeros((1200, 1600, 3), np.uint8),
        depth=FULL_DEPTH / np.float32(1000),
        intrinsics=Intrinsics(fx=2892.3, fy=2883.2, cx=823.2, cy=619.1, width=1600, height=1200),
    )
    small = shrink_view(at_full_size, 4)
    assert small.intrinsics == found.intrinsics
    np.testing.assert_array_equal(small.depth, found.depth)


@pytest.mark.parametrize(
    ("depth", "cameras", "message"),
    [
        (1000, 1, r"depth: expected 20 to 20000 mm, got a median of \d\.\d+; give lengths in millimetres"),
        (1000, 1000, "depth: expected 20 to 20000 mm"),
        (1, 1000, r"cameras: expected millimetres, .* of \d+ mm, got cameras within 0.\d+ mm"),
    ],
)
def test_lengths_that_are_no_millimetres_are_told_by_the_depth_and_the_cameras(
    tmp_path: Path, depth: float, cameras: float, message: str
) -> None:
    moved = np.array([*[[1.0, 1.0, 1.0, 1 / cameras]] * 3, [1.0] * 4])
    views = [replace(v, depth=v.depth / np.float32(depth), T_world_camera=v.T_world_camera * moved) for v in VIEWS]
    write_dtu(tmp_path, "scan7", views)
    expect_refusal(message, read_dtu, tmp_path)


def replaced(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: remove(root / DEPTHS), "scan 'scan7' has no depth"),
        (lambda root: remove(root / IMAGES), "expected images such as rect_001_3_r5000.png"),
        (lambda root: remove(root / "Cameras", "00000001*"), "00000001_cam.txt: missing"),
        (lambda root: (root / "Cameras/00000001_cam.txt").write_text("K"), "00000001_cam.txt: expected 'extrinsic'"),
        (lambda root: (root / IMAGES / "rect_002_3_r5000.png").write_bytes(b""), "not an image"),
        (lambda root: (root / "Rectified/scan8_train").mkdir(), "several scans; give --scan, one of: scan7, scan8"),
        (lambda root: (root / "Rectified").rename(root / "x"), "expected a DTU folder"),
        (
            lambda root: replaced(root / "Cameras/00000000_cam.txt", "61 0 32.5", "61 0 333"),
            r"principal point \(333, 23\) fits no image of 64x48",
        ),
        (
            lambda root: write_pfm(root / DEPTHS / "depth_map_0000.pfm", np.ones((10, 10), np.float32)),
            "depth_visual_0000.png: expected a grey image of 10x10",
        ),
        (
            lambda root: (
                write_pfm(root / DEPTHS / "depth_map_0000.pfm", np.ones((10, 10), np.float32)),
                remove(root / DEPTHS, "depth_visual_*"),
            ),
            "10x10 does not fit an image of 64x48",
        ),
    ],
)
def test_damage_of_a_scan_of_mvsnet_is_named(scan: Path, damage: Damage, message: str) -> None:
    damage(scan)
    expect_refusal(message, read_dtu, scan)


def in_unit_sphere(folder: Path) -> None:
    file = folder / "cameras_sphere.npz"
    np.savez(file, **dict(np.load(file)) | {"scale_mat_0": np.eye(4)})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "mask/001.png").unlink(), "expected a mask for each image, got none for image 1"),
        (lambda f: remove(f / "image"), "expected images such as 000000.png, got none"),
        (lambda f: (f / "cameras_sphere.npz").write_bytes(b"no"), "not the cameras of a scan"),
        (lambda f: np.savez(f / "cameras_sphere.npz", a=1), "expected world_mat_0 and so on, and scale_mat_0"),
        (in_unit_sphere, "expected a sphere of 0.02 to 20 m around the object, got 0.001 m"),
        (
            lambda f: (f / "image/000001.png").rename(f / "image/b.png") and (f / "image/000002.png").unlink(),
            "b.png: expected one picture for each of 4 cameras, or their numbers as names, got 3 and this",
        ),
        (lambda f: (f / "image/2.png").write_bytes(b"no"), r"2.png: expected one .*got 5 and this one beside 000002"),
        (lambda f: (f / "image/000001.png").write_bytes(b"no"), "000001.png: not an image that can be read"),
        (
            lambda f: cv2.imwrite(str(f / "image/000001.png"), np.zeros((12, 16, 3), np.uint8)),
            "does not lie about the middle of an image of 16x12",
        ),
        (lambda f: write_idr(f.parent, "scan8", VIEWS), "several scans; give --scan, one of: scan7, scan8"),
    ],
)
def test_damage_of_a_scan_of_idr_is_named(idr: Path, damage: Damage, message: str) -> None:
    damage(idr)
    expect_refusal(message, read_idr, idr.parent)


@pytest.mark.parametrize("scale", [1.0, -1.0, 0.37, -250.0])
def test_a_projection_of_any_scale_gives_the_camera_back(scale: float) -> None:
    matrix, T_world_camera = decompose(scale * projection(VIEWS[1])[:3], "test")
    np.testing.assert_allclose(matrix, [[K.fx, 0, K.cx], [0, K.fy, K.cy], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(T_world_camera, VIEWS[1].T_world_camera, atol=1e-12)
    said = "world_mat_2: expected a camera's projection, got a matrix that cannot be"
    expect_refusal(said, decompose, np.ones((3, 4)), "world_mat_2")


def test_a_missing_image_leaves_the_others_their_cameras_and_masks(idr: Path) -> None:
    (idr / "image/000001.png").unlink()
    scan = read_idr(idr)
    np.testing.assert_allclose(scan.views[1].T_world_camera, VIEWS[2].T_world_camera, atol=1e-9)
    np.testing.assert_array_equal(scan.views[1].mask, VIEWS[2].mask)
    np.testing.assert_allclose(scan.views[1].depth, VIEWS[2].depth, rtol=1e-6)
    (idr / "mask/001.png").unlink()
    assert scan.numbers == read_idr(idr).numbers == (0, 2, 3)


def test_without_depth_a_view_of_idr_stays_and_depth_maps_may_lie_elsewhere(tmp_path: Path, scan: Path) -> None:
    shutil.rmtree(write_idr(tmp_path / "plain", "scan7", VIEWS) / "depth")
    source = DtuSource(tmp_path / "plain")
    found = len(frames_of(source)), source.has_depth, source.loss.notes[0]
    assert found == (4, False, "000000.png: without depth")
    assert DtuSource(tmp_path / "plain", depths=scan / DEPTHS).has_depth
    expect_refusal(
        r"nowhere: expected depth_map_0000.pfm", DtuSource, tmp_path / "plain", depths=tmp_path / "nowhere"
    )
    expect_refusal(r"--depths .*: MVSNet's layout has its own", DtuSource, scan, depths=tmp_path, error=UsageError)
    expect_refusal(
        r"--masks .*: IDR's layout has its own", DtuSource, tmp_path / "plain", masks=tmp_path, error=UsageError
    )


def test_held_out_views_are_a_camera_of_their_own_and_stamps_are_view_numbers(scan: Path) -> None:
    source = DtuSource(scan, None, [1, 3])
    assert places(source) == [("camera", 0), ("holdout", 1), ("camera", 2), ("holdout", 3)]
    assert all(np.array_equal(f.color, VIEWS[f.stamp_ns].color) for f in frames_of(source))
    assert (source.cameras, source.name) == (("camera", "holdout"), "dtu/scan7")
    assert view_numbers(["2", "5"]) == [2, 5]
    protocol = replace(score_protocol("holdout:1"), training=(3, 0))  # leaves out what neither trains nor scores
    assert places(DtuSource(scan, protocol=protocol)) == [("camera", 0), ("holdout", 1), ("camera", 3)]
    expect_refusal("--holdout 4: .* has no such view; views: 0 to 3", DtuSource, scan, None, [0, 4], error=UsageError)
    expect_refusal("all 4 views of .* are held out", DtuSource, scan, None, range(4), error=UsageError)
    expect_refusal("expected view numbers such as 2,5, got 'two'", view_numbers, ["2", "two"], error=UsageError)


def test_a_view_of_mvsnet_without_depth_is_left_out_and_the_others_keep_their_numbers(scan: Path) -> None:
    (scan / DEPTHS / "depth_map_0001.pfm").unlink()
    source, said = DtuSource(scan, None, [2]), "rect_002_3_r5000.png: without depth, left out"
    assert places(source) == [("camera", 0), ("holdout", 2), ("camera", 3)]
    assert (source.loss.unpaired_color, source.loss.notes) == (1, [said])
    expect_refusal(r"--holdout 1: .* has no such view; views: 0, 2, 3", DtuSource, scan, None, [1], error=UsageError)


def test_a_view_made_smaller_sees_the_same_points_at_the_same_places() -> None:
    color = np.zeros((48, 64, 3), np.uint8)
    color[8:12, 20:24] = 200
    full = replace(VIEWS[0], color=color, mask=color[:, :, 0] > 0)
    small, expected = shrink_view(full, 4), np.zeros((12, 16, 3))
    expected[2, 5] = 200
    np.testing.assert_array_equal(small.color, expected)
    np.testing.assert_array_equal(small.mask, expected[:, :, 0] > 0)
    center_of_patch = np.array([[21.5, 9.5]])
    point = np.column_stack([(center_of_patch - [K.cx, K.cy]) / [K.fx, K.fy], [1.0]])
    np.testing.assert_allclose(project(full.intrinsics, point), center_of_patch)
    np.testing.assert_allclose(project(small.intrinsics, point), [[5.0, 2.0]])
    expect_refusal("--downscale 5: expected a whole factor of 64x48", shrink_view, full, 5, error=UsageError)


def test_a_protocol_makes_images_as_small_as_its_published_figures_are_of(tmp_path: Path) -> None:
    big = replace(VIEWS[0], intrinsics=Intrinsics(fx=700.0, fy=700.0, cx=400.0, cy=300.0, width=800, height=600))
    big = replace(big, color=np.zeros((600, 800, 3), np.uint8), depth=np.ones((600, 800), np.float32))
    write_dtu(tmp_path, "scan1", [big] * 3)
    protocol = replace(score_protocol("holdout:1"), size=(400, 300))
    sources = (
        DtuSource(tmp_path, protocol=protocol),
        DtuSource(tmp_path, protocol=protocol, downscale=1),
        DtuSource(tmp_path, protocol=replace(protocol, size=(640, 512))),
    )
    sizes = [{frame.color.shape for frame in frames_of(source)} for source in sources]
    assert sizes == [{(300, 400, 3)}, {(600, 800, 3)}, {(600, 800, 3)}]
