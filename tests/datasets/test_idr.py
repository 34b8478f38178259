"""Scans in the layout of IDR and NeuS: cameras out of projections, views, masks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.datasets.dtu import DtuView, read_dtu, write_dtu
from splatctrl_cli.datasets.dtu_source import DtuSource
from splatctrl_cli.datasets.idr import decompose, projection, read_idr, write_idr
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Intrinsics


def view(number: int) -> DtuView:
    rng = np.random.default_rng(number)
    mask = np.zeros((48, 64), np.bool_)
    mask[10:30, 20 + number : 50] = True
    return DtuView(
        name=f"{number:06d}",
        color=rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
        depth=rng.uniform(0.5, 0.8, (48, 64)).astype(np.float32),
        intrinsics=Intrinsics(fx=61.0, fy=62.0, cx=32.5, cy=23.0, width=64, height=48),
        T_world_camera=look_at([0.1 * number, -0.3, 0.1], [0.0, 0.0, 0.6]),
        mask=mask,
    )


VIEWS = [view(number) for number in range(3)]


@pytest.mark.parametrize("scale", [1.0, -1.0, 0.37, -250.0])
def test_a_projection_of_any_scale_gives_the_camera_back(scale: float) -> None:
    K, T_world_camera = decompose(scale * projection(VIEWS[1])[:3], "test")
    k = VIEWS[1].intrinsics
    np.testing.assert_allclose(K, np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]]), atol=1e-9)
    np.testing.assert_allclose(T_world_camera, VIEWS[1].T_world_camera, atol=1e-12)
    assert np.linalg.det(T_world_camera[:3, :3]) == pytest.approx(1.0)


def test_a_matrix_that_is_no_camera_is_refused() -> None:
    with pytest.raises(InputError, match=r"world_mat_2: expected a camera's projection, got a matrix that cannot be"):
        decompose(np.ones((3, 4)), "world_mat_2")


def test_a_scan_reads_the_same_from_both_layouts(tmp_path: Path) -> None:
    write_dtu(tmp_path / "mvsnet", "scan1", VIEWS)
    write_idr(tmp_path / "idr", "dtu_scan1", VIEWS)
    one, other = read_dtu(tmp_path / "mvsnet"), read_idr(tmp_path / "idr", "scan1")
    assert one.numbers == other.numbers == (0, 1, 2)
    for a, b, original in zip(one.views, other.views, VIEWS, strict=True):
        np.testing.assert_array_equal(a.color, b.color)
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=1e-9)
        assert a.intrinsics.fx == pytest.approx(b.intrinsics.fx, abs=1e-6)
        assert a.intrinsics.cy == pytest.approx(b.intrinsics.cy, abs=1e-6)
        assert b.mask is not None
        np.testing.assert_array_equal(b.mask, original.mask)


def test_a_missing_image_leaves_the_others_their_cameras_and_masks(tmp_path: Path) -> None:
    folder = write_idr(tmp_path, "scan1", VIEWS)
    (folder / "image/000001.png").unlink()
    scan = read_idr(tmp_path)
    assert scan.numbers == (0, 2)
    np.testing.assert_allclose(scan.views[1].T_world_camera, VIEWS[2].T_world_camera, atol=1e-9)
    np.testing.assert_array_equal(scan.views[1].mask, VIEWS[2].mask)
    np.testing.assert_allclose(scan.views[1].depth, VIEWS[2].depth, rtol=1e-6)
    (folder / "mask/001.png").unlink()
    assert read_idr(tmp_path).numbers == (0, 2)


def test_views_without_depth_stay_and_are_named(tmp_path: Path) -> None:
    write_idr(tmp_path, "scan1", VIEWS, with_depth=False)
    source = DtuSource(tmp_path)
    assert source.layout == "IDR"
    assert not source.has_depth
    assert len(list(source.records())) == 3
    assert source.loss.notes[0] == "000000.png: without depth"


def test_depth_maps_may_lie_elsewhere(tmp_path: Path) -> None:
    write_dtu(tmp_path / "mvsnet", "scan1", VIEWS)
    write_idr(tmp_path / "idr", "scan1", VIEWS, with_depth=False)
    source = DtuSource(tmp_path / "idr", depths=tmp_path / "mvsnet" / "Depths_raw" / "scan1")
    assert source.has_depth
    with pytest.raises(InputError, match=r"nowhere: expected depth_map_0000.pfm"):
        DtuSource(tmp_path / "idr", depths=tmp_path / "nowhere")
    with pytest.raises(UsageError, match=r"--depths .*: MVSNet's layout has its own"):
        DtuSource(tmp_path / "mvsnet", depths=tmp_path)
    with pytest.raises(UsageError, match=r"--masks .*: IDR's layout has its own"):
        DtuSource(tmp_path / "idr", masks=tmp_path)


def test_cameras_in_the_unit_sphere_are_refused(tmp_path: Path) -> None:
    folder = write_idr(tmp_path, "scan1", VIEWS)
    matrices = dict(np.load(folder / "cameras_sphere.npz"))
    np.savez(folder / "cameras_sphere.npz", **matrices | {"scale_mat_0": np.eye(4)})
    with pytest.raises(InputError, match=r"expected a sphere of 0.02 to 20 m around the object, got 0.001 m"):
        read_idr(tmp_path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "mask/001.png").unlink(), "expected a mask for each image, got none for image 1"),
        (lambda f: [p.unlink() for p in (f / "image").iterdir()], "expected images such as 000000.png, got none"),
        (lambda f: (f / "cameras_sphere.npz").write_bytes(b"no"), "not the cameras of a scan"),
        (lambda f: np.savez(f / "cameras_sphere.npz", a=1), "expected world_mat_0 and so on, and scale_mat_0"),
        (
            lambda f: (f / "image/000001.png").rename(f / "image/b.png") and (f / "image/000002.png").unlink(),
            "b.png: expected one picture for each of 3 cameras, or their numbers as names, got 2 and this",
        ),
        (lambda f: (f / "image/2.png").write_bytes(b"no"), r"2.png: expected one .*got 4 and this one beside 000002"),
        (lambda f: (f / "image/000001.png").write_bytes(b"no"), "000001.png: not an image that can be read"),
    ],
)
def test_damage_is_named(tmp_path: Path, damage: object, message: str) -> None:
    folder = write_idr(tmp_path, "scan1", VIEWS)
    assert callable(damage)
    damage(folder)
    with pytest.raises(InputError, match=message):
        read_idr(tmp_path)


def test_an_image_of_another_size_than_its_camera_is_refused(tmp_path: Path) -> None:
    small = [replace(v, color=v.color[::4, ::4], depth=v.depth[::4, ::4], mask=None) for v in VIEWS]
    write_idr(tmp_path, "scan1", small)
    with pytest.raises(InputError, match=r"does not lie about the middle of an image of 16x12"):
        read_idr(tmp_path)


def test_the_only_scan_needs_no_name_and_several_do(tmp_path: Path) -> None:
    write_idr(tmp_path, "scan1", VIEWS)
    assert read_idr(tmp_path).name == read_idr(tmp_path / "scan1").name == "scan1"
    write_idr(tmp_path, "scan2", VIEWS)
    with pytest.raises(InputError, match="several scans; give --scan, one of: scan1, scan2"):
        read_idr(tmp_path)
