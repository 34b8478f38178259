"""The picture of methods side by side."""

from pathlib import Path

import cv2
import numpy as np

from experiments.methods import clearance_picture


def test_a_picture_of_gaps_and_of_no_value_is_1200_pixels_wide_and_the_same_each_time(tmp_path: Path) -> None:
    gap = np.linspace(0.1, 0.02, 50)
    gap[10:20] = np.nan
    curves = {"one": np.linspace(0.05, 0.08, 80), "two": gap, "three": np.full(30, 0.06), "none": np.full(30, np.nan)}
    for name in ("a.png", "b.png"):
        clearance_picture(tmp_path / name, curves, 0.01, 0.02)
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None and image.shape[1] == 1200 and image.std() > 1.0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
