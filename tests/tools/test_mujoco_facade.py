"""Photographs of a facade: exact poses, stereo depth with gaps and errors, held-out views with exact depth."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.seeding import world_points
from tests.tools.test_mujoco import renderer  # noqa: F401  # chooses EGL, and skips where MuJoCo is missing
from tools.mujoco import facade


@pytest.mark.usefixtures("renderer")
def test_stereo_depth_has_gaps_and_errors_and_held_out_depth_is_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(facade, "NUM_VIEWS", 4)
    monkeypatch.setattr(facade, "HELD_OUT", 4)
    facade.write_views(tmp_path, 0, finer=1)
    frames = [r for r in open_source(tmp_path / "facade.toml", SourceOptions()).records() if isinstance(r, RgbdFrame)]
    assert [frame.camera == "holdout" for frame in frames] == [k == 2 for k in range(4)]
    camera = facade.Camera(facade.build_facade(np.random.default_rng(0)))
    for k, frame in enumerate(frames):
        exact = camera.take(frame.T_world_camera)[1]
        is_known = (frame.depth > 0) & (exact > 0)
        error, share = np.median(np.abs(frame.depth - exact)[is_known]), is_known.sum() / (exact > 0).sum()
        if k == 2:
            points = world_points(frame, exact > 0)
            assert error < 1e-3 and share == 1.0
            assert points[points[:, 2] > 0.1, 1].min() > -1.2 and points[points[:, 2] > 0.1, 1].max() < 1.0
        else:
            assert 0.005 < error < 0.03 and 0.3 < share < 0.9
