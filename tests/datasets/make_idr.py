"""Views for scans that tests write, small and with a mask."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.datasets.dtu import DtuView
from splatctrl_cli.datasets.dtu_source import shrunk


def half_size(view: DtuView) -> DtuView:
    """The view at half the size, with the middle as its mask, for speed."""
    k = view.intrinsics
    mask = np.zeros((k.height // 2, k.width // 2), np.bool_)
    mask[20:-20, 30:-30] = True
    return replace(shrunk(view, 2), mask=mask)
