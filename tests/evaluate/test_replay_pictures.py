"""Plots of replays: drawn alike each time, whatever is missing from them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from splatctrl_cli.report.replay_pictures import clearance_picture, commands_picture, open_loop_picture

NUM = 6000  # states: more than a picture has columns
SECONDS = np.linspace(0, 5, NUM)
EVENTS = {"below-margin": [(1.0, 2.0), (4.0, 4.0)], "unknown-space": [(0.0, 5.0)], "stale-map": []}


def draw_clearance(path: Path) -> None:
    curves = {name: shift + 0.05 * np.cos(SECONDS) for name, shift in (("exact", 0.0), ("barrier", -0.01))}
    gaps = np.where(SECONDS < 2, np.nan, 0.03)
    clearance_picture(
        path, SECONDS, curves | {"certified": gaps, "truth": np.full(NUM, np.nan)}, 0.02, "Clearance", EVENTS
    )


def draw_quiet_clearance(path: Path) -> None:
    clearance_picture(path, np.zeros(1), {"exact": np.array([0.1])}, 0.02, "Clearance", {})


def draw_commands(path: Path) -> None:
    velocity = np.stack([np.sin(SECONDS), 0.001 * np.cos(SECONDS)], axis=1)
    velocity[:100] = np.nan
    joints, limits = ("shoulder", "elbow"), np.array([0.9, 2.0])
    commands_picture(path, SECONDS, velocity, joints, limits, {"scene": [(1.0, 2.0)], "self": []}, velocity + 0.1)


def draw_open_loop(path: Path) -> None:
    difference = np.stack([np.sin(SECONDS), np.cos(SECONDS)], axis=1)
    open_loop_picture(path, SECONDS, difference, ("shoulder", "elbow"), np.cos(SECONDS), [(1.0, 1.0)])


@pytest.mark.parametrize("draw", [draw_clearance, draw_quiet_clearance, draw_commands, draw_open_loop])
def test_a_plot_is_1200_pixels_wide_and_the_same_each_time(tmp_path: Path, draw: Callable[[Path], None]) -> None:
    before = dict(mpl.rcParams)
    draw(tmp_path / "a.png")
    draw(tmp_path / "b.png")
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None and image.shape[1] == 1200 and image.std() > 1.0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert dict(mpl.rcParams) == before


def test_each_kind_of_event_that_came_up_has_a_row(tmp_path: Path) -> None:
    draw_clearance(tmp_path / "two.png")
    image = np.asarray(cv2.imread(str(tmp_path / "two.png")), dtype=np.int64)
    orange, purple, brown = ((0, 159, 230), (167, 121, 204), (59, 109, 138))
    widths = [int(np.all(np.abs(image - color) < 3, axis=2).sum(axis=1).max()) for color in (orange, purple, brown)]
    assert widths[1] > 3 * widths[0] > 0 and widths[2] == 0
