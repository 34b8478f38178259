"""A time step that shows something new leaves a map, whether one is due or not."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatctrl_cli.config import Config
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.jobs.reconstruct.kept_maps import KeptMaps
from splatctrl_cli.records import Label
from tests.field.scenes import splat_set
from tests.plain import known, plain_grid

VOXEL = 0.02  # of 50 x 50 x 50 around the origin, free where x > -0.2, never seen elsewhere
THING = np.array([[0.1, 0.1, 0.1], [0.12, 0.1, 0.1], [0.1, 0.12, 0.1]])
FLOOR = np.array([[x, y, -0.3] for x in np.arange(-0.4, 0.4, 0.02) for y in np.arange(-0.4, 0.4, 0.02)])


def kept(folder: Path, splats: ArrayLike) -> KeptMaps:
    """After one map with these splats."""
    folder.mkdir()
    writer = SceneWriter(folder, {"frame": "world"})
    x = -0.5 + VOXEL * np.arange(50)[:, None, None]
    grid = plain_grid(
        (50, 50, 50), VOXEL, -0.5, num_updates=np.broadcast_to(x > -0.2, (50, 50, 50)).astype(np.uint16)
    )
    centers = np.asarray(splats, np.float64).reshape(-1, 3)
    writer.snapshot(0, splat_set(centers, np.full(len(centers), 0.01)), known(grid), grid.states(0.3, 0.7))
    return KeptMaps(writer, Config())


def shown(
    centers: ArrayLike, radius: float = 0.01, unrepresented: ArrayLike = (), label: Label = Label.OBJECT
) -> Any:
    """What a fitter has at a later time step."""
    points = np.asarray(centers, np.float64).reshape(-1, 3)
    splats = splat_set(points, np.full(len(points), radius), label)
    grid = plain_grid((50, 50, 50), VOXEL, -0.5)
    return SimpleNamespace(
        splats=lambda: splats, unrepresented=known(grid, 0, unrepresented, int(label)).unrepresented
    )


@pytest.mark.parametrize(
    ("before", "now", "is_new"),
    [
        pytest.param(FLOOR, shown(FLOOR), False, id="nothing new"),
        pytest.param(FLOOR, shown([*FLOOR, *THING]), True, id="a thing"),
        pytest.param(FLOOR, shown([*FLOOR, *THING[:2]]), False, id="noise"),
        pytest.param(FLOOR, shown(FLOOR, unrepresented=THING), True, id="a thing without a splat"),
        pytest.param(FLOOR, shown([*FLOOR, *(THING - [0.4, 0, 0])]), False, id="in space that was never seen"),
        pytest.param(FLOOR, shown(FLOOR + np.array([0, 0, 0.009])), False, id="half a voxel higher"),
        pytest.param(FLOOR, shown(FLOOR + np.array([0, 0, 0.012])), True, id="more than half a voxel higher"),
        pytest.param(FLOOR, shown(FLOOR, radius=0.025), True, id="grown"),
        pytest.param(FLOOR, shown([*FLOOR[:-9]]), False, id="gone"),
        pytest.param((), shown(THING), True, id="the first thing of all"),
        pytest.param(FLOOR, shown(THING, label=Label.ROBOT), False, id="the robot"),
    ],
)
def test_a_map_is_kept_for_something_new(tmp_path: Path, before: ArrayLike, now: Any, is_new: bool) -> None:
    assert kept(tmp_path / "scene", before).shows_news(now) == is_new


def test_before_the_first_map_nothing_is_new(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    assert not KeptMaps(SceneWriter(tmp_path / "scene", {}), Config()).shows_news(shown(THING))
