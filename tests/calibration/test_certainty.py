"""How sure a calibration is of all its cameras."""

import numpy as np
import pytest

from splatctrl_cli.calibration.certainty import Certainty
from splatctrl_cli.calibration.evidence import POSE, Unknowns
from splatctrl_cli.config import fixed


@pytest.mark.parametrize("uncertain", ["cam0", "cam1", None])
def test_a_calibration_is_full_where_every_camera_is_certain(uncertain: str | None) -> None:
    cameras = ("cam0", "cam1")
    sigma = {name: fixed.CALIBRATION_SIGMA * (2.0 if name == uncertain else 0.5) for name in cameras}
    covariance = np.diag(np.repeat([sigma[name] ** 2 for name in cameras], POSE))
    certainty = Certainty(
        unknowns=Unknowns(cameras=cameras, poses=cameras), covariance=covariance, reach=np.eye(2 * POSE)
    )
    assert certainty.is_full == (uncertain is None)
