"""Which views are scored and what is known at their time; PSNR, SSIM and depth errors against known answers."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatctrl_cli.evaluate.views import (
    depth_errors,
    psnr,
    published_ssim,
    seen_by,
    seen_pixels,
    ssim_map,
    surface_points,
    views_to_score,
)
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Float64, Intrinsics, JointState, LossReport, Record, RgbdFrame
from tests.plain import plain_frame
from tests.reference.images import ssim_at


def frame(stamp_ns: int, camera: str) -> RgbdFrame:
    return plain_frame(
        1.0, Intrinsics(fx=1.0, fy=1.0, cx=0.5, cy=0.5, width=2, height=2), stamp_ns=stamp_ns, camera=camera
    )


class FakeSource:
    """Records from a list."""

    name = "fake"
    cameras = ("a", "b", "held/out")
    joint_names: tuple[str, ...] = ()
    has_clock = True
    loss = LossReport()

    def __init__(self, records: list[Record]) -> None:
        self._records = records

    def records(self) -> Iterator[Record]:
        return iter(self._records)

    def digests(self) -> dict[str, str]:
        return {}


JOINTS = JointState(stamp_ns=1, position=np.zeros(1), velocity=np.zeros(1))
RECORDS: list[Record] = [
    *(frame(0, "held/out"), JOINTS, frame(1, "a"), frame(1, "held/out"), frame(1, "b")),
    *(frame(2, "a"), frame(3, "held/out"), frame(4, "b")),
]


def known(has_clock: bool, training: tuple[str, ...] = ("a", "b")) -> list[tuple[str, list[tuple[str, int]]]]:
    views = views_to_score(FakeSource(RECORDS), scoring=["held/out"], training=training, has_clock=has_clock)
    return [(view.name, sorted((f.camera, f.stamp_ns) for f in view.training)) for view in views]


def test_with_a_clock_the_newest_frame_of_each_camera_up_to_that_very_stamp_counts() -> None:
    """Only training cameras count, and a recording without frames has no view."""
    assert known(has_clock=True) == [
        ("held_out-0000", []),
        ("held_out-0001", [("a", 1), ("b", 1)]),
        ("held_out-0002", [("a", 2), ("b", 1)]),
    ]
    assert known(has_clock=True, training=("b",))[2] == ("held_out-0002", [("b", 1)])
    assert not [*views_to_score(FakeSource([]), scoring=["a"], training=["b"], has_clock=True)]


def test_without_a_clock_every_training_frame_counts() -> None:
    every = [("a", 1), ("a", 2), ("b", 1), ("b", 4)]
    assert known(has_clock=False) == [("held_out-0000", every), ("held_out-0002", every), ("held_out-0005", every)]


def test_a_log_is_scored_at_the_poses_that_its_scene_was_trained_at() -> None:
    views = views_to_score(
        FakeSource(RECORDS),
        scoring=["held/out"],
        training=["a"],
        has_clock=True,
        corrected=lambda frame: replace(frame, T_world_camera=2.0 * np.eye(4)),
    )
    frames = [frame for view in views for frame in (view.frame, *view.training)]
    assert len(frames) == 3 + 2 and all(np.array_equal(frame.T_world_camera, 2.0 * np.eye(4)) for frame in frames)


def test_stamps_that_number_the_views_name_them() -> None:
    views = views_to_score(
        FakeSource(RECORDS), scoring=["held/out"], training=["a"], has_clock=False, numbered_by_stamp=True
    )
    assert [view.name for view in views] == ["held_out-0000", "held_out-0001", "held_out-0003"]


INTRINSICS = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)


def wall_frame(T_world_camera: Float64 | None = None) -> RgbdFrame:
    depth = np.full((48, 64), 2.0, dtype=np.float32)
    depth[:, :32] = 1.0
    depth[0] = 0.0
    return plain_frame(depth, INTRINSICS, T_world_camera)


def points(values: ArrayLike) -> Float64:
    return np.asarray(values, dtype=np.float64).reshape(-1, 3)


LAST = (63.5 - 31.5) / 50 * 2.0  # [m] right of the middle where the image of the wall ends


@pytest.mark.parametrize(
    ("point", "is_seen"),
    [
        *(([0.5, 0.0, 2.0], True), ([0.5, 0.0, 2.019], True), ([0.5, 0.0, 2.021], False), ([0.5, 0.0, 1.979], False)),
        pytest.param([-0.5, 0.0, 2.0], False, id="behind a surface"),
        pytest.param([0.5, 0.0, 1.0], False, id="in front of it"),
        pytest.param([0.5, 0.0, -2.0], False, id="behind the camera"),
        pytest.param([0.0, 0.0, 0.0], False, id="at the camera"),
        pytest.param([5.0, 0.0, 2.0], False, id="beside the image"),
        pytest.param([0.5, -3.0, 2.0], False, id="above the image"),
        pytest.param([0.5, (0 - 23.5) / 50 * 2.0, 2.0], False, id="at a pixel without depth"),
        pytest.param([LAST - 4e-4, 0.0, 2.0], True, id="within half of the last pixel"),
        pytest.param([LAST + 4e-4, 0.0, 2.0], False, id="beyond half of the last pixel"),
    ],
)
def test_a_point_on_a_measured_surface_is_seen_within_the_tolerance(point: list[float], is_seen: bool) -> None:
    assert seen_by(points(point), [wall_frame()]).tolist() == [is_seen]
    assert seen_by(points([[0.5, 0.0, 2.021], [0.5, 0.0, 1.979]]), [wall_frame()], tolerance=0.03).all()


def test_a_frame_sees_all_its_own_surface_from_any_pose() -> None:
    frame = wall_frame(look_at([1.0, 2.0, 3.0], [0.0, 0.0, 0.5]))
    own, valid = surface_points(frame)
    assert len(own) == 47 * 64 == valid.sum() and seen_by(own, [frame]).all()
    assert np.array_equal(seen_pixels(frame, [frame]), valid)


def test_what_is_seen_does_not_hang_on_the_order_of_the_cameras() -> None:
    frame = wall_frame(look_at([0.5, -2.0, 0.4], [0.0, 0.0, 0.5]))
    others = [wall_frame(look_at([0.1 * n, -2.0, 0.4], [0.2, 0.0, 0.5])) for n in (4, 0, 6)]
    seen = seen_pixels(frame, others)
    assert 0 < seen.sum() < seen.size and np.array_equal(seen, seen_pixels(frame, others[::-1]))


def test_any_frame_suffices_and_no_frame_sees_nothing() -> None:
    away = wall_frame(look_at([0.0, 0.0, 0.0], [0.0, 0.0, -1.0], up=(0.0, 1.0, 0.0)))
    for frames, is_seen in (([away], False), ([away, wall_frame()], True), ([], False)):
        assert seen_by(points([[0.5, 0.0, 2.0]]), frames).tolist() == [is_seen]
    assert seen_by(points([]), [wall_frame()]).shape == (0,)


def noise(seed: int, shape: tuple[int, ...] = (24, 31, 3)) -> Float64:
    return np.random.default_rng(seed).random(shape)


def test_psnr_of_a_constant_offset_of_a_tenth_is_20_db() -> None:
    """Identical images give infinity, an empty mask gives NaN."""
    assert psnr(0.5 * noise(0) + 0.1, 0.5 * noise(0)) == pytest.approx(20.0, abs=1e-9)
    assert psnr(noise(0), noise(0)) == math.inf
    assert math.isnan(psnr(noise(0), noise(1), np.zeros((24, 31), dtype=bool)))


def test_psnr_averages_only_masked_pixels() -> None:
    image, mask = np.full((10, 10, 3), 0.5), np.broadcast_to(np.arange(10) < 1, (10, 10))
    other = np.where(mask[..., None], image + 0.1, 0.0)
    assert psnr(other, image, mask) == pytest.approx(20.0, abs=1e-9)
    zero_filled = psnr(other * mask[..., None], image * mask[..., None])
    assert zero_filled == pytest.approx(30.0, abs=1e-9), "the mean over a zero-filled image would read 10 dB more"


def test_ssim_map_equals_the_reference_window_by_window_and_at_the_border() -> None:
    x, y = noise(3), np.clip(noise(3) + 0.2 * noise(4), 0, 1)
    similarity = ssim_map(x, y)
    for row, column, channel in itertools.product((0, 12, 23), (0, 15, 30), range(3)):
        assert similarity[row, column, channel] == pytest.approx(
            ssim_at(x[..., channel], y[..., channel], row, column), abs=1e-12
        )


def test_depth_errors_count_only_pixels_where_both_have_depth() -> None:
    reference = np.array([[1.0, 1.0, 1.0, 0.0, 1.0]], dtype=np.float32)
    errors = depth_errors(np.array([[1.005, 1.015, 1.1, 1.0, 0.0]], dtype=np.float32), reference)
    assert list(errors.values()) == pytest.approx([3, 0.015, 0.04, 0.015 + 0.8 * 0.085, 1 / 3, 2 / 3], abs=1e-6)
    assert list(errors)[1:4] == ["depth_median", "depth_mean", "depth_p90"]
    none = depth_errors(np.zeros((3, 3), np.float32), np.ones((3, 3), np.float32))
    assert none["depth_pixels"] == 0 and math.isnan(none["depth_median"]) and math.isnan(none["depth_within_1cm"])


def test_zeros_beyond_the_border_make_it_look_alike() -> None:
    image, reference = noise(5), noise(6)
    padded = [np.pad(x, ((5, 5), (5, 5), (0, 0))) for x in (image, reference)]
    found, plain = ssim_map(image, reference, is_zero_padded=True), ssim_map(image, reference)
    np.testing.assert_allclose(found, ssim_map(*padded)[5:-5, 5:-5], atol=1e-12)
    np.testing.assert_allclose(found[5:-5, 5:-5], plain[5:-5, 5:-5], atol=1e-12)
    assert found[0].mean() > plain[0].mean() + 0.05


def test_published_ssim_is_the_box_window_of_scikit_image_on_filled_images() -> None:
    rng = np.random.default_rng(5)
    image, reference = rng.random((14, 17, 3)), rng.random((14, 17, 3))
    mask, values = rng.random((14, 17)) < 0.7, []
    x, y = (np.where(mask[:, :, None], picture, 1.0) for picture in (image, reference))
    for row, column, channel in itertools.product(range(3, 11), range(3, 14), range(3)):
        window = np.s_[row - 3 : row + 4, column - 3 : column + 4, channel]
        a, b = x[window].ravel(), y[window].ravel()
        covariance, c1, c2 = np.cov(a, b), 0.02**2, 0.06**2
        alike = (2 * a.mean() * b.mean() + c1) * (2 * covariance[0, 1] + c2)
        values.append(alike / ((a.mean() ** 2 + b.mean() ** 2 + c1) * (covariance[0, 0] + covariance[1, 1] + c2)))
    assert published_ssim(image, reference, mask, 1.0) == pytest.approx(np.mean(values), abs=1e-12)
    assert np.isnan(published_ssim(image, reference, mask & False, 1.0)), "not the 1 of two white images"
    assert math.isnan(published_ssim(image[:5], reference[:5], mask[:5], 1.0))
