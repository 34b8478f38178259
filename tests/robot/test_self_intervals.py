"""A self-model of an arm that takes a box at a time and puts it down later, found with the time that it held it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from splatctrl_cli.geometry import pose_at
from splatctrl_cli.kernels.surface_image import TriangleTree
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.robot.self_fusion import choose_moments, learn
from splatctrl_cli.robot.self_intervals import VOXEL, Fused, Interval, choose_intervals
from splatctrl_cli.robot.self_model import ALWAYS, SelfModel
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import Shape
from tests.robot.test_self_model import LINKS, ROBOT, poses, recorded, shapes

EDGE, IN_ARM = 0.05, pose_at((0.415, 0.0, 0.0))  # of a box at the arm's tip, which ends at x = 0.395
PATH = [(0.9 * np.sin(0.37 * k), 0.35 * np.sin(0.9 * k + 1.0)) for k in range(24)]
PERIOD = 100_000_000  # [ns] between two moves


def box(link: str, T: Float64) -> Shape:
    return Shape(link=link, kind="box", size=(EDGE, EDGE, EDGE), T_link_shape=T)


def seen(
    moves: Sequence[tuple[float, float]], held: range, noise: float = 0.0, *, has_bracket: bool = False
) -> tuple[list[RgbdFrame], Float64]:
    """Frames in which the box is in the arm at the moves `held`, before and after where it is taken and put down."""
    frames, at = [], []
    for number, move in enumerate(moves):
        still = poses(*moves[min(max(number, held.start), held.stop - 1)])["arm"] @ IN_ARM
        its = box("arm", IN_ARM) if number in held else box("world", still)
        new, poses_of = recorded([move], RobotSurface.from_parts([*shapes(has_bracket=has_bracket), its]), noise)
        frames += [replace(frame, stamp_ns=number * PERIOD) for frame in new]
        at.append(poses_of)
    return frames, np.concatenate(at)


@cache
def learned(start: int, stop: int, noise: float = 0.0, *, has_bracket: bool = False) -> SelfModel:
    return learn(ROBOT, LINKS, *seen(PATH, range(start, stop), noise, has_bracket=has_bracket))


def off_box(triangles: Float64) -> float:
    """How far [m] a surface is outside the box, and the box's free sides from the surface, at most."""
    outside = RobotSurface.from_parts([box("arm", IN_ARM)]).distance(np.eye(4)[None], triangles.reshape(-1, 3)).max()
    ticks = (-0.02, 0.0, 0.02)
    shown = [(EDGE / 2, a, b) for a in ticks for b in ticks]  # its lower side is not
    shown += [(x, y, EDGE / 2) for x in (0.0, 0.02) for y in ticks]
    shown += [(x, side * EDGE / 2, z) for x in (0.0, 0.02) for z in ticks[1:] for side in (-1, 1)]
    return float(max(outside, TriangleTree(triangles).closest(IN_ARM[:3, 3] + np.array(shown))[0].max()))


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_box_that_is_taken_and_put_down_is_robot_in_between(noise: float) -> None:
    (part,) = learned(8, 17, noise).temporary
    assert (part.link, learned(8, 17, noise).pieces()) == ("arm", [])
    assert part.start_ns == pytest.approx(7.5 * PERIOD, abs=PERIOD)
    assert part.end_ns == pytest.approx(16.5 * PERIOD, abs=PERIOD)
    assert off_box(part.triangles) < VOXEL


@pytest.mark.parametrize("start, stop", [(0, 14), (10, 24), (0, 24)])
def test_what_is_held_from_the_first_or_until_the_last_moment_has_no_bound_there(start: int, stop: int) -> None:
    (part,) = [part for part in learned(start, stop).learned if len(part.triangles)]
    bounds = [ALWAYS[0] if start == 0 else (start - 0.5) * PERIOD, ALWAYS[1] if stop == 24 else (stop - 0.5) * PERIOD]
    assert part.start_ns == pytest.approx(bounds[0], abs=PERIOD if start else 0)
    assert part.end_ns == pytest.approx(bounds[1], abs=0 if stop == 24 else PERIOD)


def test_a_bracket_is_robot_always_beside_a_box_that_is_held_for_a_time() -> None:
    found = learned(8, 17, has_bracket=True)
    (_, bracket), (part,) = found.pieces()[0], found.temporary
    assert bracket[..., 2].min() > 0.03 and part.triangles[..., 0].min() > 0.37
    assert found.changes() == [part.start_ns, part.end_ns]
    counts = [len(found.held_at(stamp)) for stamp in (0, part.start_ns, part.end_ns - 1, part.end_ns)]
    assert (len(found.pieces()), counts) == (1, [0, 1, 1, 0])


def test_what_stands_beside_the_arm_while_it_stays_is_not_taken() -> None:
    """The arm comes to the box, waits and wags a little, and goes on."""
    wait = [(PATH[8][0] + 0.02 * np.sin(k), PATH[8][1]) for k in range(8)]
    found = learn(ROBOT, LINKS, *seen([*PATH[:8], *wait, *PATH[9:]], range(8, 9)))
    assert [part for part in found.learned if len(part.triangles)] == []


def test_moments_part_a_way_there_and_back() -> None:
    turns = [*np.linspace(0, 1.5, 30), *np.linspace(1.5, 0, 30)]
    chosen = choose_moments(ROBOT, np.array([ROBOT.poses(poses(turn, 0.0)) for turn in turns]), most=12)
    assert len(chosen) == 12 and max(np.diff(chosen)) <= 9


@pytest.mark.parametrize(("num_sure", "is_whole"), [(4, True), (2, False), (0, False)])
def test_a_thin_thing_is_whole_where_enough_of_its_piece_is_surely_there(num_sure: int, is_whole: bool) -> None:
    """A rod of 12 cells aslant: a surface in six of ten configurations, or in four and free in three."""
    mask = np.ones((14, 14, 14), np.bool_)
    rod = np.zeros((14, 14, 14), np.bool_)
    steps = np.arange(1, 13)
    rod[steps, steps, 3] = True
    seen, free = np.zeros((2, 10, mask.size), np.bool_)
    cells = np.flatnonzero(rod)
    seen[:6, cells[:num_sure]] = True
    seen[:4, cells[num_sure:]] = free[6:9, cells[num_sure:]] = True
    weight = (seen | free).astype(np.float32)
    fused = Fused(total=-0.002 * weight, weight=weight, seen=seen, free=free)
    found = choose_intervals(fused, mask, np.full(mask.size, 0.02), [Interval(first=0, last=9)])
    assert np.flatnonzero(found == 0).tolist() == cells[: 12 if is_whole else num_sure].tolist()
