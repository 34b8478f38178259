"""How figures of states fold over them."""

import numpy as np

from splatctrl_cli.evaluate.metrics import largest, lowest


def test_a_residual_that_is_infinite_is_not_left_out_of_thelargest() -> None:
    assert largest(np.array([1e-9, np.inf, np.nan])) is None
    assert largest(np.array([1e-9, 2e-9, np.nan])) == 2e-9
    assert largest(np.array([np.nan])) is None
    assert lowest(np.array([np.nan, -np.inf, 1.0])) == -np.inf
