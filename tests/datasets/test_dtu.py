"""DTU scans: what is written reads back; K and depth of real layouts are scaled; damage is named."""

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.datasets.dtu import DtuView, read_dtu, read_image, write_dtu
from splatctrl_cli.datasets.dtu_source import shrunk
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.pfm import read_pfm, write_pfm
from splatctrl_cli.geometry import invert_transform, look_at, project
from splatctrl_cli.records import Intrinsics

K = Intrinsics(fx=90.0, fy=92.0, cx=33.0, cy=23.0, width=64, height=48)


def view(number: int) -> DtuView:
    rng = np.random.default_rng(number)
    depth = rng.uniform(0.5, 1.5, (48, 64)).astype(np.float32)
    depth[:5] = 0
    return DtuView(
        name=f"view{number}",
        color=rng.integers(0, 256, (48, 64, 3)).astype(np.uint8),
        depth=depth,
        intrinsics=K,
        T_world_camera=look_at([1.0, 0.2 * number, 0.5], [0.0, 0.0, 0.0]),
    )


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    write_dtu(tmp_path / "dtu", "scan7", [view(0), view(1), view(2)])
    return tmp_path / "dtu"


def resized(root: Path, size: tuple[int, int], camera: tuple[str, np.ndarray], depth: np.ndarray) -> None:
    """Give view 0 of a scan another image size, camera file and depth map, as DTU's variants have."""
    for path in (root / "Rectified/scan7_train").iterdir():
        path.unlink()
    image = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    cv2.imwrite(str(root / "Rectified/scan7_train/rect_001_3_r5000.png"), image)
    text = (root / "Cameras/00000000_cam.txt").read_text().split("intrinsic")[0]
    rows = "\n".join(" ".join(str(value) for value in row) for row in camera[1])
    (root / "Cameras" / camera[0]).parent.mkdir(exist_ok=True)
    (root / "Cameras" / camera[0]).write_text(f"{text}intrinsic\n{rows}\n\n425.0 2.5\n")
    write_pfm(root / "Depths_raw/scan7/depth_map_0000.pfm", depth)
    (root / "Depths_raw/scan7/depth_visual_0000.png").unlink()


def test_a_written_scan_reads_back(scan: Path) -> None:
    result = read_dtu(scan)
    assert (result.name, len(result.views), result.without_depth) == ("scan7", 3, ())
    for number, found in enumerate(result.views):
        expected = view(number)
        assert found.name == f"rect_{number + 1:03d}_3_r5000"
        assert found.intrinsics == K
        np.testing.assert_array_equal(found.color, expected.color)
        np.testing.assert_allclose(found.depth, expected.depth, rtol=2e-7)
        np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=1e-8)
    assert len(result.files) == 12


def test_camera_files_hold_world_to_camera_in_millimetres(scan: Path) -> None:
    words = (scan / "Cameras/00000001_cam.txt").read_text().split()
    extrinsic = np.array(words[1:17], dtype=float).reshape(4, 4)
    expected = invert_transform(view(1).T_world_camera)
    np.testing.assert_allclose(extrinsic[:3, :3], expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(extrinsic[:3, 3], expected[:3, 3] * 1000, atol=1e-5)


def test_pairs_name_the_nearest_camera_first(scan: Path) -> None:
    lines = (scan / "Cameras/pair.txt").read_text().splitlines()
    assert lines[0] == "3"
    assert [line.split()[1::2] for line in lines[2::2]] == [["1", "2"], ["0", "2"], ["1", "0"]]


def test_training_cameras_are_for_a_quarter_of_the_image(scan: Path) -> None:
    quarter = np.array([[361.5, 0, 82.9], [0, 360.4, 66.4], [0, 0, 1]])
    resized(scan, (640, 512), ("train/00000000_cam.txt", quarter), np.full((128, 160), 700, np.float32))
    found = read_dtu(scan).views[0]
    assert found.intrinsics.fx == pytest.approx(1446.0)
    assert (found.intrinsics.cx, found.intrinsics.cy) == pytest.approx((331.6, 265.6))
    assert np.count_nonzero(found.depth) == 128 * 160
    np.testing.assert_allclose(found.depth[::4, ::4], 0.7)


def test_full_cameras_and_depth_are_halved_and_cropped(scan: Path) -> None:
    full = np.array([[2892.3, 0, 823.2], [0, 2883.2, 619.1], [0, 0, 1]])
    depth = (np.arange(1600 * 1200, dtype=np.float32) % 4099).reshape(1200, 1600) + 100
    resized(scan, (640, 512), ("00000000_cam.txt", full), depth)
    found = read_dtu(scan).views[0]
    assert found.intrinsics.fx == pytest.approx(1446.15)
    assert (found.intrinsics.cx, found.intrinsics.cy) == pytest.approx((331.6, 265.55))
    assert found.depth.shape == (512, 640)
    np.testing.assert_allclose(found.depth[10, 20] * 1000, depth[2 * (10 + 44), 2 * (20 + 80)], rtol=1e-6)


def test_cameras_and_depth_of_the_full_size_fit_images_made_smaller(scan: Path) -> None:
    """A patch of 4x4 pixels of the full image is one pixel of the small one; its middle stays where it was."""
    full = np.array([[2892.3, 0, 823.2], [0, 2883.2, 619.1], [0, 0, 1]])
    depth = (np.arange(1600 * 1200, dtype=np.float32) % 4099).reshape(1200, 1600) + 100
    resized(scan, (400, 300), ("00000000_cam.txt", full), depth)
    found = read_dtu(scan).views[0]
    middle = np.array([[4 * 30 + 1.5, 4 * 20 + 1.5]])
    point = np.column_stack([(middle - full[:2, 2]) / np.diag(full)[:2], [1.0]])
    np.testing.assert_allclose(project(found.intrinsics, point), [[30.0, 20.0]], atol=1e-9)
    at_full_size = replace(
        found,
        color=np.zeros((1200, 1600, 3), np.uint8),
        depth=depth / np.float32(1000),
        intrinsics=Intrinsics(fx=2892.3, fy=2883.2, cx=823.2, cy=619.1, width=1600, height=1200),
    )
    small = shrunk(at_full_size, 4)
    assert small.intrinsics == found.intrinsics
    np.testing.assert_array_equal(small.depth, found.depth)


def test_pixels_that_depth_visual_hides_have_no_depth(scan: Path) -> None:
    shown = np.full((48, 64), 255, np.uint8)
    shown[20:30, 20:30] = 0
    cv2.imwrite(str(scan / "Depths_raw/scan7/depth_visual_0001.png"), shown)
    depth = read_dtu(scan).views[1].depth
    assert (depth[20:30, 20:30] == 0).all()
    assert (depth[31:] > 0).all()


def test_depth_that_is_not_finite_is_none(scan: Path) -> None:
    depth = np.full((48, 64), 700, np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = np.nan, np.inf, -5
    write_pfm(scan / "Depths_raw/scan7/depth_map_0000.pfm", depth)
    (scan / "Depths_raw/scan7/depth_visual_0000.png").unlink()
    np.testing.assert_allclose(read_dtu(scan).views[0].depth[0, :4], [0, 0, 0, 0.7])


def test_views_without_depth_are_left_out_and_named(scan: Path) -> None:
    (scan / "Depths_raw/scan7/depth_map_0002.pfm").unlink()
    result = read_dtu(scan)
    assert [found.name for found in result.views] == ["rect_001_3_r5000", "rect_002_3_r5000"]
    assert result.without_depth == ("rect_003_3_r5000.png",)


def test_light_three_is_taken_where_there_are_several(scan: Path) -> None:
    folder = scan / "Rectified/scan7_train"
    for light in (0, 6):
        cv2.imwrite(str(folder / f"rect_001_{light}_r5000.png"), np.zeros((48, 64, 3), np.uint8))
    assert read_dtu(scan).views[0].name == "rect_001_3_r5000"


def test_lengths_that_are_no_millimetres_are_told_by_the_depth_and_the_cameras(tmp_path: Path) -> None:
    def in_metres(some: DtuView, *, depth: bool = False, cameras: bool = False) -> DtuView:
        T_world_camera = some.T_world_camera.copy()
        T_world_camera[:3, 3] /= 1000 if cameras else 1
        return replace(some, depth=some.depth / np.float32(1000 if depth else 1), T_world_camera=T_world_camera)

    write_dtu(tmp_path / "depth", "scan7", [in_metres(view(n), depth=True) for n in range(3)])
    with pytest.raises(
        InputError, match=r"depth: expected 20 to 20000 mm, got a median of 0.99\d; lengths have to be"
    ):
        read_dtu(tmp_path / "depth")
    write_dtu(tmp_path / "both", "scan7", [in_metres(view(n), depth=True, cameras=True) for n in range(3)])
    with pytest.raises(InputError, match="depth: expected 20 to 20000 mm"):
        read_dtu(tmp_path / "both")
    write_dtu(tmp_path / "cameras", "scan7", [in_metres(view(n), cameras=True) for n in range(3)])
    with pytest.raises(InputError, match=r"cameras: expected millimetres, .* of \d+ mm, got cameras within 0.2 mm"):
        read_dtu(tmp_path / "cameras")


def remove_all(root: Path, pattern: str) -> None:
    for path in root.glob(pattern):
        path.unlink()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: remove_all(root, "Depths_raw/scan7/*"), "scan 'scan7' has no depth"),
        (lambda root: remove_all(root, "Rectified/scan7_train/*"), "expected images such as rect_001_3_r5000.png"),
        (lambda root: remove_all(root, "Cameras/00000001*"), "00000001_cam.txt: missing"),
        (lambda root: (root / "Cameras/00000001_cam.txt").write_text("K"), "00000001_cam.txt: expected 'extrinsic'"),
        (lambda root: (root / "Rectified/scan7_train/rect_002_3_r5000.png").write_bytes(b""), "not an image"),
        (lambda root: (root / "Rectified/scan8_train").mkdir(), "several scans; give --scan, one of: scan7, scan8"),
    ],
)
def test_damage_is_named(scan: Path, damage: object, message: str) -> None:
    assert callable(damage)
    damage(scan)
    with pytest.raises(InputError, match=message):
        read_dtu(scan)


def test_a_scan_that_is_not_there_is_refused_with_the_choices(scan: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scan 'scan9'; give --scan, one of: scan7"):
        read_dtu(scan, "scan9")
    with pytest.raises(InputError, match="expected a DTU folder"):
        read_dtu(tmp_path)


def test_a_camera_that_fits_no_image_size_is_refused(scan: Path) -> None:
    text = (scan / "Cameras/00000000_cam.txt").read_text()
    (scan / "Cameras/00000000_cam.txt").write_text(text.replace("90 0 33", "90 0 333"))
    with pytest.raises(InputError, match=r"principal point \(333, 23\) fits no image of 64x48"):
        read_dtu(scan)


def test_depth_of_a_size_that_fits_nothing_is_refused(scan: Path) -> None:
    write_pfm(scan / "Depths_raw/scan7/depth_map_0000.pfm", np.ones((10, 10), np.float32))
    (scan / "Depths_raw/scan7/depth_visual_0000.png").unlink()
    with pytest.raises(InputError, match="10x10 does not fit an image of 64x48"):
        read_dtu(scan)


@pytest.mark.parametrize("is_little", [True, False])
def test_pfm_of_either_byte_order_starts_at_the_bottom_row(tmp_path: Path, is_little: bool) -> None:
    rows = np.array([[3, 4], [1, 2]], dtype="<f4" if is_little else ">f4")
    (tmp_path / "a.pfm").write_bytes(f"Pf\n2 2\n{'-1.0' if is_little else '1'}\n".encode() + rows.tobytes())
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P6\n2 2\n255\n", "expected a PFM image"),
        (b"PF\n2 2\n-1.0\n", "expected one channel"),
        (b"Pf\n2 2\n-2.5\n" + b"\0" * 16, "of scale 1, got Pf of scale -2.5"),
        (b"Pf\n2 2\n-1.0\n" + b"\0" * 15, "expected 16 bytes for 2x2, got 15"),
        (b"Pf\n0 " + b"8" * 55 + b"\n-1.0\n", "expected pixels, got 0x888"),
    ],
)
def test_damaged_pfm_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.pfm").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_pfm(tmp_path / "a.pfm")


def test_the_sample_scan_is_seen_the_same_from_two_views(sample_data: Path) -> None:
    views = read_dtu(sample_data / "dtu").views
    assert len(views) == 8
    a, b = views[2], views[3]
    v, u = np.mgrid[60:150:10, 60:200:10]
    z = a.depth[v, u].astype(np.float64)
    k = a.intrinsics
    points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z, np.ones_like(z)], -1)
    in_b = points @ (invert_transform(b.T_world_camera) @ a.T_world_camera).T
    ub, vb = in_b[..., 0] / in_b[..., 2] * k.fx + k.cx, in_b[..., 1] / in_b[..., 2] * k.fy + k.cy
    inside = (ub > 0) & (ub < k.width - 1) & (vb > 0) & (vb < k.height - 1)
    error = np.abs(b.depth[np.rint(vb[inside]).astype(int), np.rint(ub[inside]).astype(int)] - in_b[..., 2][inside])
    assert inside.sum() > 80
    assert np.median(error) < 0.003


def test_a_cut_photograph_is_refused_and_a_turned_one_keeps_its_pixels(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    jpeg = bytes(cv2.imencode(".jpg", pixels)[1])
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)  # EXIF: turn by 90 degrees
    exif = b"Exif\x00\x00" + b"II*\x00" + struct.pack("<IH", 8, 1) + entry + bytes(4)
    path = tmp_path / "rect_001.jpg"
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    assert read_image(path).shape == (8, 12, 3)
    assert np.array_equal(read_image(path), cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])
    path.write_bytes(jpeg[: len(jpeg) // 2])
    with pytest.raises(InputError, match="not an image that can be read"):
        read_image(path)
