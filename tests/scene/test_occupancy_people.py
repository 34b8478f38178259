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


def at(view: RgbdFrame, time_s: float, *, seen: bool = True) -> RgbdFrame:
    """The frame at a time; not seen: without depth, as of a camera that is covered."""
    depth = view.depth if seen else np.zeros_like(view.depth)
    return replace(view, stamp_ns=round(time_s * 1e9), depth=depth)


def grid() -> OccupancyMap:
    return OccupancyMap(WORKSPACE, OccupancyConfig(), 1)


HERE, GONE = masked(frame(block=VISITOR)), blind(frame())


def test_what_nobody_sees_stays_human_for_the_memory_and_is_then_unknown() -> None:
    voxels, people = grid(), PeopleMemory(2.0)
    people.take_in(voxels, [at(HERE, 0.0)])
    there = voxels.entity & Label.HUMAN > 0
    assert there.sum() > 50
    people.take_in(voxels, [at(HERE, 1.0, seen=False)])
    people.take_in(voxels, [at(HERE, 2.0, seen=False)])
    assert humans(voxels) == there.sum()
    people.take_in(voxels, [at(HERE, 2.1, seen=False)])
    assert humans(voxels) == 0
    states = voxels.grid().states(0.3, 0.7)
    assert (states[there] == VoxelState.NEVER_SEEN).all()


def test_a_person_who_is_seen_again_is_remembered_anew() -> None:
    voxels, people = grid(), PeopleMemory(2.0)
    for time_s, seen in ((0.0, True), (1.5, True), (3.0, False), (3.4, False)):
        people.take_in(voxels, [at(HERE, time_s, seen=seen)])
    assert humans(voxels) > 50
    people.take_in(voxels, [at(HERE, 3.6, seen=False)])
    assert humans(voxels) == 0


def test_what_is_seen_free_is_human_no_longer_whatever_the_memory() -> None:
    voxels, people = grid(), PeopleMemory(99.0)
    people.take_in(voxels, [at(HERE, 0.0)])
    people.take_in(voxels, [at(GONE, 0.1)])
    assert humans(voxels) == 0
    assert len(people.voxels) == 0


def test_frames_without_masks_that_look_through_a_person_take_the_label() -> None:
    voxels, people = grid(), PeopleMemory(99.0)
    people.take_in(voxels, [at(HERE, 0.0)])
    people.take_in(voxels, [at(frame(), 0.1)])
    assert humans(voxels) == 0
    assert len(people.voxels) == 0


@pytest.mark.parametrize(("memory", "stays"), [(0.5, False), (5.0, True)])
def test_the_splats_of_a_forgotten_person_go(memory: float, stays: bool) -> None:
    target = SceneFitter(
        SceneConfig(max_splats=1200, first_iterations=60, iterations_per_step=0),
        OccupancyConfig(),
        WORKSPACE,
        human=HumanConfig(memory=memory),
    )
    target.step([at(HERE, 0.0)])
    assert (target.splats().labels == Label.HUMAN).sum() > 20
    target.step([at(HERE, 1.0, seen=False)])
    splats = target.splats()
    assert ((splats.labels == Label.HUMAN).sum() > 20) == stays
    assert ((splats.centers[:, 2] > 0.1).sum() > 20) == stays
