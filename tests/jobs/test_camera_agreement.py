"""Views that do not fit together, refused before a map is made of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import InputError
from splatctrl_cli.jobs.camera_agreement import CameraAgreement
from splatctrl_cli.jobs.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.jobs.progress import SILENT
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.time_steps import TimeStep


@pytest.fixture(scope="module")
def views(sample_data: Path) -> list[RgbdFrame]:
    """Of a still scene, from different places."""
    source = open_to_train(RecordingRequest(path=sample_data / "dtu", is_dtu=True))
    return [record for record in source.records() if isinstance(record, RgbdFrame)]


def check(views: list[RgbdFrame], factor: float, *, is_allowed: bool = False, is_still: bool = True) -> None:
    scaled = tuple(replace(view, depth=view.depth * np.float32(factor)) for view in views)
    made = CameraAgreement("scene", is_allowed=is_allowed, is_still=is_still)
    made.check(TimeStep(frames=scaled, position=None), OccupancyConfig(max_range=100.0), SILENT)


def test_views_at_their_own_scale_pass(views: list[RgbdFrame]) -> None:
    check(views, 1.0)


@pytest.mark.parametrize("factor", [10.0, 0.1])
def test_depths_ten_times_too_far_or_near_are_refused_with_the_option_to_give(
    views: list[RgbdFrame], factor: float
) -> None:
    with pytest.raises(InputError) as refused:
        check(views, factor)
    assert "--depth-scale" in (refused.value.remedy or "")
    assert "--allow-disagreement" in (refused.value.remedy or "")
    check(views, factor, is_allowed=True)
