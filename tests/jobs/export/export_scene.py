"""Scenes of splats to be exported."""

from pathlib import Path

import numpy as np

from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.records import SplatSet
from tests.plain import plain_splats


def ball(num: int = 400) -> SplatSet:
    directions = np.random.default_rng(0).normal(size=(num, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return plain_splats(
        0.3 * directions + [0.5, 0.0, 0.2],
        0.02,
        colors=0.5 + 0.4 * directions,
        opacities=np.linspace(0.2, 1.0, num),
        labels=np.arange(num) % 3,
    )


def written(folder: Path, splats: SplatSet) -> Path:
    """A scene folder of them."""
    folder.mkdir()
    write_ply(folder / "splats.ply", splats, {"scene": "ball"})
    return folder
