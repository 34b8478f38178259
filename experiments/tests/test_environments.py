"""Drawn environments, and the task in each: the same by the seed, of the sizes stated, with a way that is clear."""

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from experiments import drawn_task
from experiments.drawn_task import Task, solids_of, task_of
from experiments.environments import ENVIRONMENTS, Environment, drawn, ring_of_cameras
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, simulate
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.planner.planned import resample
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.primitives import signed_distance
from splatctrl_cli.simulate.recording import Recording, RecordingOptions, Scene
from tests.refused import expect_refusal
from tests.robot.shapes import covering_spheres, folding_arm
from tests.simulate.limits import DURATIONS, assert_keeps_limits


@pytest.fixture(scope="module")
def tasks(arm: RobotModel) -> Iterator[Callable[[str], Task]]:
    """The task of seed 1 by kind, each found once, from few postures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawn_task, "TASK_GUESSES", 8)
        yield cache(lambda kind: task_of(kind, 1, arm))


def environment(kind: str, seed: int) -> Environment:
    return drawn(kind, np.random.default_rng(seed))


def distance(made: Environment, points: Float64) -> Float64:
    return np.min([signed_distance(thing, points) for thing in made.primitives], axis=0)


@pytest.mark.parametrize("kind", ENVIRONMENTS)
def test_a_seed_draws_one_environment_and_another_seed_another(kind: str) -> None:
    def solids(seed: int) -> list[tuple[object, ...]]:
        return [(p.name, p.size, p.T_world_shape.tolist(), p.texture) for p in environment(kind, seed).primitives]

    assert solids(4) == solids(4) != solids(5)


def test_tables_carry_3_to_15_things_that_neither_meet_nor_hang_in_the_air() -> None:
    numbers = []
    for seed in range(40):
        made = environment("tabletop", seed)
        tables = [p for p in made.primitives if p.name.startswith("table")]
        things = [p for p in made.primitives if not p.name.startswith("table")]
        numbers.append(len(things))
        for thing in things:
            below = thing.T_world_shape[:3, 3] - [
                0,
                0,
                0.5 * (thing.size[2] if thing.kind == "box" else thing.size[1]),
            ]
            on = [abs(float(signed_distance(table, below[None])[0])) for table in tables]
            assert min(on) < 1e-9
            others = [p for p in things if p is not thing]
            gap = min((float(signed_distance(p, thing.T_world_shape[:3, 3][None])[0]) for p in others), default=1.0)
            assert gap > 0
            assert all(0.025 <= size <= 0.40 for size in thing.size)
    assert min(numbers) >= 3 and max(numbers) <= 15 and len(set(numbers)) > 5


def test_a_merged_shelf_is_the_shelf_without_one_divider() -> None:
    for seed in range(10):
        whole, merged = ({p.name for p in environment(kind, seed).primitives} for kind in ("cubby", "merged-cubby"))
        (missing,) = whole - merged
        assert missing.startswith(("upright", "board")) and merged < whole


@pytest.mark.parametrize("kind", ["cubby", "merged-cubby"])
def test_every_opening_takes_a_hand_whose_way_in_is_free(kind: str) -> None:
    for seed in range(10):
        made = environment(kind, seed)
        for T in made.places:
            way = T[:3, 3] - np.linspace(0, 0.30, 7)[:, None] * T[:3, 2]
            assert (distance(made, way) > 0.05).all()


@pytest.mark.parametrize("kind", ENVIRONMENTS)
def test_the_task_is_a_clear_way_between_places_that_are_apart(
    kind: str, arm: RobotModel, tasks: Callable[[str], Task]
) -> None:
    task = tasks(kind)
    room = Clearance.of(arm, solids_of(task.environment.primitives))
    assert room.at(resample(task.waypoints, 0.01)).min() > drawn_task.TASK_CLEARANCE - 1e-3
    tip = arm.frame_names[-1]
    start, end = (arm.frame_pose(q, tip) for q in task.waypoints[[0, -1]])
    np.testing.assert_allclose(end[:3, 3], task.T_world_goal[:3, 3], atol=1e-3)
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) > drawn_task.TASK_APART - 2e-3


def test_a_seed_gives_one_task(arm: RobotModel, tasks: Callable[[str], Task]) -> None:
    task, again = tasks("tabletop"), task_of("tabletop", 1, arm)
    assert again.waypoints.tolist() == task.waypoints.tolist() and again.num_refused == task.num_refused


def test_an_arm_that_reaches_no_opening_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(drawn_task, "TASK_ENVIRONMENTS", 1)
    expect_refusal(
        "expected a way in one of 1 of kind cubby", task_of, "cubby", 0, folding_arm(tmp_path, covering_spheres())[0]
    )


@pytest.mark.parametrize("duration", DURATIONS)
def test_the_way_through_it_keeps_the_velocity_limits_in_any_time(
    arm: RobotModel, tasks: Callable[[str], Task], duration: float
) -> None:
    options = RecordingOptions(duration_s=duration, fps=10.0)
    assert_keeps_limits(Recording(options, arm, tasks("cubby").scene(arm, options, 4)))


def test_a_log_is_written_of_it_with_its_truth(tmp_path: Path, tasks: Callable[[str], Task]) -> None:
    options = RecordingOptions(duration_s=8, fps=0.5, width=64, height=48, color_rays=0)

    def scene(model: RobotModel) -> Scene:
        return tasks("merged-cubby").scene(model, options, 5)

    result = simulate(SimulateRequest(out=tmp_path / "cubby", options=options, scene=scene))
    assert result.metrics["frames"] == {f"cam{n}": 4 for n in range(5)}
    assert result.truth.clearance.min() > drawn_task.TASK_CLEARANCE - 1e-3


def test_cameras_look_into_a_shelf() -> None:
    for camera in ring_of_cameras(2, 320, 240):
        assert camera.T_world_camera[0, 2] > 0.5  # forward, as the openings are seen
