"""Which plan a trial takes: of those of a way the one that comes to least unseen space; others where none leads; and
a controller's way out."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from experiments import judge, trial
from experiments.maps import Map
from experiments.problems import Problem, Views
from experiments.trial import LITTLE, PLANS, Attempt, Rig, by_planner
from experiments.ways import Way
from splatctrl_cli.config import Config
from splatctrl_cli.control.goals import Detour, PlanDetour, TimedPath
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.planner.configuration_clearance import HasDistance
from splatctrl_cli.records import Float64

NONE = Attempt(position=None, cause=judge.NO_PLAN)


@pytest.fixture
def rig(problem: Problem, views: Views) -> Rig:
    return Rig(problem=problem, views=views, config=Config(), threads=1, stopwatch=Stopwatch())


def chosen(
    rig: Rig, unseen: dict[int, float], monkeypatch: pytest.MonkeyPatch, *, num_ways: int = 2, is_told: bool = True
) -> tuple[Attempt, list[int]]:
    """The attempt where the plan of a seed comes to so much unseen space, [l], and the seeds that were tried."""
    tried = []

    def planned(rig: Rig, scene: HasDistance, config: Config) -> Attempt:
        tried.append(config.planner.seed)
        position = np.full((2, 7), unseen.get(tried[-1], np.nan))
        return NONE if np.isnan(position).any() else replace(NONE, position=position, cause="")

    def ways() -> Iterator[Way]:
        way = Way(scene=rig.problem.solids, margin=0.02, unseen_on=lambda position: 1e-3 * float(position[0, 0]))
        return (way if is_told else replace(way, unseen_on=None) for _ in range(num_ways))

    monkeypatch.setattr(trial, "_planned", planned)
    return by_planner(rig, Map(scene=rig.problem.solids, ways=ways)), tried


def test_the_plan_is_taken_that_comes_to_least_space_that_no_camera_saw(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt, tried = chosen(rig, {0: 5.0, 1: 3.0, 3: 2.0, 5: 4.0}, monkeypatch)
    assert attempt.position[0, 0] == 2.0
    assert tried == list(range(PLANS))


@pytest.mark.parametrize(("unseen", "is_told"), [(1e3 * LITTLE, True), (5.0, False)])
def test_one_plan_does_where_it_comes_to_little_or_nobody_tells(
    rig: Rig, unseen: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt, tried = chosen(rig, dict.fromkeys(range(PLANS), unseen), monkeypatch, is_told=is_told)
    assert attempt.position is not None and tried == [0]


def test_a_way_is_given_up_after_one_search_and_the_last_after_others(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt, tried = chosen(rig, {1: 1.0, PLANS: 2.0}, monkeypatch)
    assert attempt.position[0, 0] == 2.0
    assert tried == [0, *range(PLANS, 2 * PLANS)]
    attempt, tried = chosen(rig, {2 * PLANS + 1: 0.0}, monkeypatch)
    assert attempt.position is not None and tried == [0, PLANS, 2 * PLANS, 2 * PLANS + 1]
    attempt, tried = chosen(rig, {}, monkeypatch)
    assert attempt == NONE and len(tried) == 2 + PLANS


def test_a_way_out_is_the_safest_that_keeps_the_margin_or_else_any(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    margin, asked = rig.config.control.margin, []
    scenes = {name: replace(rig.problem.solids) for name in ("known", "less margin", "unseen", "any")}
    ways = [Way(scene=scenes["known"], margin=margin), Way(scene=scenes["less margin"], margin=0.4 * margin)]
    ways.append(Way(scene=scenes["unseen"], margin=margin))
    leads = {"any"}

    def planned(model: object, scene_at: Callable[[int], HasDistance], *_: object, home: Float64) -> PlanDetour:
        def out(stamp_ns: int, q: Float64, T_world_goal: Float64) -> Detour | None:
            (name,) = [name for name, scene in scenes.items() if scene is scene_at(stamp_ns)]
            asked.append(name)
            return Detour(path=cast(TimedPath, name), wait_distance=0.05) if name in leads else None

        return out

    monkeypatch.setattr(trial, "planned_detours", planned)
    way_out = trial._way_out(rig, Map(scene=scenes["any"], ways=lambda: iter(ways)))
    for name, order in (("any", ["known", "unseen", "any"]), ("unseen", ["known", "unseen"])):
        leads.add(name)
        found = way_out(0, rig.problem.start, np.eye(4))
        assert (found.path, asked) == (name, order)
        asked.clear()
