"""The picture of several motions' clearance."""

from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.report.methods_picture import methods_picture


def test_every_curve_is_drawn_whatever_its_length_and_gaps(tmp_path: Path) -> None:
    gap = np.linspace(0.1, 0.02, 50)
    gap[10:20] = np.nan
    whole = {"one": np.linspace(0.05, 0.08, 80), "two": gap}
    for name, curves in (
        ("some", whole),
        ("more", whole | {"three": np.full(30, 0.06), "none": np.full(30, np.nan)}),
    ):
        methods_picture(tmp_path / f"{name}.png", curves, 0.01, 0.02)
    some, more = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("some", "more"))
    assert some is not None and more is not None
    assert some.shape == more.shape
    assert not np.array_equal(some, more)
