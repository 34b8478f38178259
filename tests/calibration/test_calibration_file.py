"""A calibration reads back as it was written, and is refused where it is damaged; how sure it may be."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.calibration.calibration_file import (
    CalibratedCamera,
    Calibration,
    calibration_text,
    describe_calibration,
    is_calibration,
    read_calibration,
)
from splatctrl_cli.calibration.certainty import Certainty
from splatctrl_cli.calibration.evidence import POSE, Unknowns
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import look_at
from tests.refused import expect_refusal

RIG = Calibration(
    recording='a "log".mcap',
    world_frame="world",
    digests={"log.mcap": "00ff"},
    cameras={
        "front": CalibratedCamera(
            T=look_at([1.0, 0.2, 0.9], [0.3, 0.0, 0.1]),
            recorded=look_at([1.02, 0.2, 0.9], [0.3, 0.0, 0.1]),
            scale=1.02,
            depth_noticed=(0.004, 0.003),
            bias=-0.003,
            covariance=np.diag(np.arange(6) * 1e-7),
            unobserved=("translation along the table's normal",),
        ),
        "wrist": CalibratedCamera(T=np.eye(4), recorded=None, as_recorded=("depth scale", "depth bias")),
    },
    clock=-0.0123,
    sigma_clock=0.0004,
)
TABLES = {"T": None, "recorded": None, "covariance": None}  # arrays, compared apart


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(calibration_text(RIG))
    return path


def test_a_calibration_reads_back_as_it_was_written(written: Path) -> None:
    read = read_calibration(written)
    for name, camera in RIG.cameras.items():
        np.testing.assert_allclose(read.cameras[name].T, camera.T, atol=1e-12)
        assert replace(read.cameras[name], **TABLES) == replace(camera, **TABLES)
    np.testing.assert_array_equal(read.cameras["front"].covariance, RIG.cameras["front"].covariance)
    assert replace(read, cameras={}) == replace(RIG, cameras={})
    assert read.cameras["wrist"].moves and not read.cameras["front"].moves
    assert is_calibration(written)
    assert "not observed: translation along the table's normal" in str(describe_calibration(written).grids[0].rows)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("splatctrl-calibration", "something", "expected a calibration, got another file"),
        ("version = 1", "version = 2", "expected version 1, got 2"),
        ("depth_scale = 1.02", "depth_scale = -1.02", "damaged"),
        ("depth_scale = 1.02", "depth_scale = nan", "damaged"),
        ("depth_scale = 1.02", "depth_scale = 1000.0", "damaged"),
        ("depth_scale", "depth_scalf", "damaged"),
        ("[clock]", "[clock", "not valid TOML"),
    ],
)
def test_another_or_damaged_file_is_refused(written: Path, old: str, new: str, says: str) -> None:
    written.write_text(written.read_text().replace(old, new, 1))
    expect_refusal(says, read_calibration, written)


@pytest.mark.parametrize("uncertain", ["cam0", "cam1", None])
def test_a_calibration_is_full_where_every_camera_is_certain(uncertain: str | None) -> None:
    cameras = ("cam0", "cam1")
    sigma = {name: fixed.CALIBRATION_SIGMA * (2.0 if name == uncertain else 0.5) for name in cameras}
    covariance = np.diag(np.repeat([sigma[name] ** 2 for name in cameras], POSE))
    certainty = Certainty(
        unknowns=Unknowns(cameras=cameras, poses=cameras), covariance=covariance, reach=np.eye(2 * POSE)
    )
    assert certainty.is_full == (uncertain is None)
