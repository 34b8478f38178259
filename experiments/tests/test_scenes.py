"""The study of twelve scenes: a way is known, the cube counts as the arm's while it is carried, runs are paired."""

from dataclasses import replace

import numpy as np
import pytest

from experiments import judge
from experiments.environments import box, drawn_texture
from experiments.pick_and_place import CUBE, HEIGHTS, LAYOUTS
from experiments.registry import STUDIES
from experiments.scenes import ROOM, Scene, _ends, problems, read_scene
from experiments.scenes_table import NAMES, notes, sections
from experiments.scenes_trial import BIRRT, HIT_GRASPING, QP_IK, QP_IK_ALONE, Transport, Trial
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.planner.configuration_clearance import Clearance
from tests.refused import expect_refusal

SETTINGS = STUDIES["scenes"].config


@pytest.fixture(scope="module")
def scene() -> Scene:
    return read_scene("scattered-0000")


def trial(scene: Scene, width: int = 80) -> Trial:
    return Trial(scene=scene, run=0, config=SETTINGS, width=width, threads=1, stopwatch=Stopwatch())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_postures_over_cube_and_bowl_are_clear_of_everything_with_the_cube_in_the_hand(layout: str) -> None:
    for number in range(len(HEIGHTS)):
        scene = read_scene(f"{layout}-{number:04d}")
        before, after = scene.to_cube(), scene.to_bowl(scene.hover)
        assert Clearance.of(before.model, before.solids).at(before.goal[None])[0] >= min(ROOM, 0.04)
        ends = np.array([after.start, after.goal])
        alone = Clearance.of(after.model.replace_self_pairs(judge.NO_PAIRS), after.solids)
        assert alone.at(ends).min() >= ROOM
        assert len(after.model.sphere_set.radii) > len(before.model.sphere_set.radii)


def test_a_scene_in_which_the_carried_cube_would_pass_within_5_cm_has_no_way(scene: Scene) -> None:
    cube = scene.drawn.T_world_place[:3, 3] - [0.0, 0.0, 0.120]  # its lower side
    for gap, has_way in ((0.04, False), (0.07, True)):
        below = box("thing", (0.02, 0.02, 0.004), cube - [0.0, 0.0, gap], drawn_texture(np.random.default_rng(0)))
        drawn = replace(scene.drawn, things=(*scene.drawn.things, below))
        assert (_ends(drawn, scene.model) is not None) is has_way


def test_a_name_that_is_none_is_refused() -> None:
    for name in ("scattered", "kitchen-0001", "wall-x"):
        expect_refusal("expected LAYOUT-NUMBER", read_scene, name)


def test_what_the_cube_touches_on_the_way_is_a_collision_of_the_arm_that_carries_it(scene: Scene) -> None:
    problem = scene.to_bowl(scene.hover)
    T = problem.model.frame_pose(problem.goal, "hand")
    below = T[:3, 3] - [0.0, 0.0, 0.120 + 0.004]  # just under the cube, 14 mm below the fingertips
    thing = box("thing", (0.02, 0.02, 0.004), below, drawn_texture(np.random.default_rng(0)))
    problem, views = replace(problem, things=(*problem.things, thing)), trial(scene)._views
    way = np.array([problem.start, problem.goal])
    assert judge.against_truth(problem, way, views).has_collided
    empty = judge.against_truth(replace(problem, model=scene.model), way, views)
    assert not empty.has_collided


def test_a_way_down_to_the_cube_that_touches_something_fails(scene: Scene) -> None:
    place = scene.drawn.cube.T_world_shape[:3, 3]
    texture = drawn_texture(np.random.default_rng(0))
    beside = box("post", (0.02, 0.02, 0.10), (place[0], place[1] + 0.09, 0.05), texture)
    blocked = replace(scene, drawn=replace(scene.drawn, things=(*scene.drawn.things, beside)))
    assert trial(scene)._not_taken(scene.hover) == ""
    assert trial(blocked)._not_taken(scene.hover) == HIT_GRASPING


def test_the_cube_is_carried_over_the_bowl_by_both_methods(scene: Scene) -> None:
    run = trial(scene, width=160)
    for method in (QP_IK, BIRRT):
        row = run.by(method)
        assert row.success
        assert not row.cause
        assert row.verdict in ("safe", "not evaluable")
        assert not row.is_false_green
        assert row.true_clearance > 0.02
        assert row.field_clearance > 0.02
        assert row.position_error < 0.03
        assert row.joint_path_rad > 1.5
        assert (row.in_known_space is None) is (method == QP_IK)


def rows() -> list[Transport]:
    """Six runs of two methods; QP-IK's ways are 1 rad shorter, and one of the planner's fails."""
    found = []
    for number in range(3):
        for run in range(2):
            base = Transport(
                layout="wall",
                number=number,
                run=run,
                method=QP_IK,
                success=True,
                cause="",
                verdict="safe",
                true_clearance=0.03,
                field_clearance=0.036,
                duration_s=8.0,
                joint_path_rad=4.0 + number,
                effector_path_m=1.0,
                effector_path_deg=90.0,
            )
            failed = number == 2 and run == 1
            planned = replace(base, method=BIRRT, joint_path_rad=5.0 + number, true_clearance=0.019)
            found += [base, replace(planned, success=False, cause="no plan found") if failed else planned]
    return found


def section(title: str, found: list[Transport]) -> dict[tuple[str, ...], tuple[str, ...]]:
    """Rows of a section by their first two cells."""
    (chosen,) = [lines for name, _, lines in sections(found) if name.startswith(title)]
    return {(line[0], line[1]): tuple(line[2:]) for line in chosen}


def test_successes_and_what_came_nearer_than_2_cm_stand_beside_the_papers() -> None:
    found = section("The cube", rows())
    assert found[NAMES[QP_IK], "6/6"][1:5] == ("0/6", "0/6", "3.6", "3.0")
    assert found[NAMES[BIRRT], "5/6"][1:5] == ("0/6", "6/6", "3.6", "1.9")
    assert found[NAMES[BIRRT], "5/6"][5].startswith("23/24")


def test_figures_are_those_of_successful_runs_and_pairs_are_of_the_same_run() -> None:
    assert section("The same", rows())[NAMES[BIRRT], "joints [rad]"][:3] == ("5", "-1.00", "-1.00 to -1.00")
    assert section("The same", rows())[NAMES[BIRRT], "succeeded"][:2] == ("6", "1 and 0 alone")
    panels = section("Of the successful", rows())
    assert (NAMES[BIRRT], "5.80 [4.76, 6.84]") in panels
    assert (NAMES[QP_IK], "5.00 [4.06, 5.94]") in panels
    assert section("Failures", rows()) == {(NAMES[BIRRT], "1"): ("no plan found",)}


def test_scenes_are_twelve_or_a_part_that_says_so() -> None:
    assert (len(problems(None, archive=None)), len(problems(1, archive=None))) == (12, 4)
    assert "Sampled: 3 of 12 scenes." in list(notes(rows()))
    assert NAMES[QP_IK_ALONE] not in str(list(sections(rows())))
    assert CUBE == 0.05
