"""Views that are brighter or more coloured than others, brought to one exposure."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.calibration.exposure import exposed, exposure_gains
from splatctrl_cli.records import RgbdFrame
from tests.calibration.scan import gains_of, views_of


@pytest.fixture(scope="module")
def views(sample_data: Path) -> list[RgbdFrame]:
    return views_of(sample_data)


def test_gains_are_found_to_a_percent(views: list[RgbdFrame]) -> None:
    gains = gains_of(len(views))
    off = [exposed(view, 1 / gain) for view, gain in zip(views, gains, strict=True)]
    assert np.abs(np.log(exposure_gains(off) / gains)).max() < 0.01


def test_views_of_one_exposure_need_none(views: list[RgbdFrame]) -> None:
    assert np.abs(np.log(exposure_gains(views))).max() < 0.005


def test_one_view_is_brought_to_the_others_that_stay(views: list[RgbdFrame]) -> None:
    gain = np.array([1.2, 1.0, 0.9])
    free = np.arange(len(views)) == 0
    found = exposure_gains([exposed(views[0], 1 / gain), *views[1:]], 1.0, free)
    assert found[0] == pytest.approx(gain, rel=0.01)
    assert found[1:] == pytest.approx(1.0)


def test_what_is_white_or_black_says_nothing(views: list[RgbdFrame]) -> None:
    """A white wall stays 255 at any exposure; it must not pull a gain to 1."""
    gains = np.ones((len(views), 3))
    gains[0] = 1.25
    white = []
    for view, gain in zip(views, gains, strict=True):
        brighter = exposed(view, 1 / gain)
        brighter.color[view.color.min(axis=-1) > 120] = 255
        white.append(brighter)
    found = exposure_gains(white)
    assert np.median(found[0] / found[1:].mean(axis=0)) == pytest.approx(1.25, rel=0.02)


def test_a_view_that_shares_nothing_keeps_its_colours(views: list[RgbdFrame]) -> None:
    gains = exposure_gains([views[0]])
    assert gains == pytest.approx(1.0)
