"""Pictures of scored views: one scale for all, holes told from what was not recorded, the mask's outline."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.records import UInt8
from splatctrl_cli.report.pictures import ComparisonRow
from splatctrl_cli.report.view_picture import renders_picture, view_picture

H, W = 30, 40


def row(color_error: float) -> ComparisonRow:
    depth = np.ones((H, W), np.float32)
    return ComparisonRow(
        title="holdout-0000",
        figures="dB: 20.0 all",
        photo=np.full((H, W, 3), 102, np.uint8),
        render=np.full((H, W, 3), 0.4 + color_error, np.float32),
        photo_depth=depth,
        render_depth=depth.copy(),
    )


def drawn(path: Path, row: ComparisonRow) -> UInt8:
    view_picture(path, row)
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape[1] == 1200
    return np.asarray(image[:, :, ::-1])


def panel(image: UInt8, right: bool) -> UInt8:
    """The middle of an error's panel."""
    height = image.shape[0]
    x = 860 if right else 260
    return image[int(0.7 * height) : int(0.8 * height), x - 60 : x + 60]


def test_errors_have_one_scale_whatever_the_view(tmp_path: Path) -> None:
    small, large, larger = (
        panel(drawn(tmp_path / "a.png", row(e)), right=False).mean((0, 1)) for e in (0.05, 0.1, 0.3)
    )
    assert np.abs(small - large).max() > 50
    assert np.abs(large - larger).max() < 1, "10% and more have the top colour"


def test_what_was_not_rendered_is_orange_and_what_was_not_recorded_grey(tmp_path: Path) -> None:
    hole, unknown = row(0.0), row(0.0)
    hole.render_depth[:] = 0.0
    unknown.photo_depth[:] = 0.0
    assert panel(drawn(tmp_path / "a.png", hole), right=True).mean((0, 1)) == pytest.approx([0xD5, 0x5E, 0], abs=2)
    assert panel(drawn(tmp_path / "b.png", unknown), right=True).mean((0, 1)) == pytest.approx([0xD9] * 3, abs=2)


def test_the_mask_is_outlined(tmp_path: Path) -> None:
    mask = np.zeros((H, W), np.bool_)
    mask[10:20, 10:30] = True
    plain, outlined, whole = (
        drawn(tmp_path / "a.png", replace(row(0.0), mask=m)) for m in (None, mask, np.ones((H, W), np.bool_))
    )
    height = plain.shape[0] // 2
    assert not np.array_equal(plain[60 : height - 30], outlined[60 : height - 30])
    assert np.array_equal(plain[60 : height - 30], whole[60 : height - 30]), "nothing to outline"


def test_methods_stand_side_by_side_with_their_errors(tmp_path: Path) -> None:
    photo = row(0.0).photo
    exact, off = row(0.0).render, row(0.3).render
    renders_picture(tmp_path / "a.png", "holdout-0000", photo, {"one": exact, "other": off})
    renders_picture(tmp_path / "b.png", "holdout-0000", photo, {"one": exact, "other": exact})
    a, b = (cv2.imread(str(tmp_path / name)) for name in ("a.png", "b.png"))
    assert a is not None
    assert b is not None
    assert a.shape == b.shape
    assert np.array_equal(a[40:, 420:790], b[40:, 420:790]), "the first method's column"
    assert not np.array_equal(a[40:, 810:], b[40:, 810:])
