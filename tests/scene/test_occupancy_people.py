"""How long voxels that nobody sees stay a person's."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import HumanConfig, OccupancyConfig, SceneConfig
from splatctrl_cli.records import Label, RgbdFrame
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.occupancy import OccupancyMap, PeopleMemory
from splatctrl_cli.voxels import VoxelState
from tests.scene.test_labels import VISITOR, blind, humans, masked
from tests.scene.wall import WORKSPACE, frame

HERE, GONE = masked(frame(block=VISITOR)), blind(frame())
DARK = replace(HERE, depth=np.zeros_like(HERE.depth))


def seen(memory: float, *views: tuple[float, RgbdFrame]) -> tuple[OccupancyMap, list[int], PeopleMemory]:
    """The grid that took in these views at their times [s], how many voxels were human after each, and the memory."""
    voxels, people, counts = OccupancyMap(WORKSPACE, OccupancyConfig(), 1), PeopleMemory(memory), []
    for time_s, view in views:
        people.take_in(voxels, [replace(view, stamp_ns=round(time_s * 1e9))])
        counts.append(humans(voxels))
    return voxels, counts, people


def test_what_nobody_sees_stays_human_for_the_memory_and_is_then_unknown() -> None:
    """DARK is of a camera that is covered."""
    there = seen(2.0, (0.0, HERE))[0].entity & Label.HUMAN > 0
    voxels, counts, _ = seen(2.0, (0.0, HERE), (1.0, DARK), (2.0, DARK), (2.1, DARK))
    assert there.sum() > 50 and counts == [there.sum()] * 3 + [0]
    assert (voxels.grid().states(0.3, 0.7)[there] == VoxelState.NEVER_SEEN).all()


def test_a_person_who_is_seen_again_is_remembered_anew() -> None:
    _, counts, _ = seen(2.0, (0.0, HERE), (1.5, HERE), (3.0, DARK), (3.4, DARK), (3.6, DARK))
    assert counts[3] > 50 and counts[4] == 0


@pytest.mark.parametrize("after", [GONE, frame()], ids=["masked", "without masks"])
def test_what_is_seen_free_is_human_no_longer_whatever_the_memory(after: RgbdFrame) -> None:
    _, counts, people = seen(99.0, (0.0, HERE), (0.1, after))
    assert counts[1] == len(people.voxels) == 0


@pytest.mark.parametrize(("memory", "stays"), [(0.5, False), (5.0, True)])
def test_the_splats_of_a_forgotten_person_go(memory: float, stays: bool) -> None:
    config, human = (
        SceneConfig(max_splats=1200, first_iterations=60, iterations_per_step=0),
        HumanConfig(memory=memory),
    )
    target = SceneFitter(config, OccupancyConfig(), WORKSPACE, human=human)
    target.step([HERE])
    assert (target.splats().labels == Label.HUMAN).sum() > 20
    target.step([replace(DARK, stamp_ns=1_000_000_000)])
    splats = target.splats()
    assert ((splats.labels == Label.HUMAN).sum() > 20) == ((splats.centers[:, 2] > 0.1).sum() > 20) == stays
