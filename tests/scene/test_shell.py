"""The shell over a floor that goes on beyond the workspace, with a block that stands across its border."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.formats.splat.splats import check_splats
from splatctrl_cli.kernels.points import SplatTree
from splatctrl_cli.records import Bool, Box, RgbdFrame, SplatSet
from splatctrl_cli.scene.backdrop import pixels_beyond
from splatctrl_cli.scene.checkpoint import fitter_state, restore_fitter
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.render import BLACK, render
from splatctrl_cli.scene.seeding import world_points
from tests.scene.wall import INTRINSICS, WORKSPACE, frame, looking_down

REACH = Box(lower=np.array([-0.2, -0.35, -0.05]), upper=np.array([0.2, 0.35, 0.6]))  # the floor is seen to 0.49 m
CONFIG = SceneConfig(max_splats=1500, first_iterations=100, iterations_per_step=10)
ACROSS = 0.2  # [m] where a block stands half within reach
MIN_RANGE = OccupancyConfig().min_range


def fitter(*, has_shell: bool = True, reach: Box = REACH, threads: int = 1, **changes: float) -> SceneFitter:
    config = replace(CONFIG, **changes)  # type: ignore[arg-type]
    return SceneFitter(config, OccupancyConfig(), reach, threads=threads, has_shell=has_shell)


def shell_of(target: SceneFitter) -> SplatSet:
    """The shell, which has splats, all of them beyond."""
    shell = target.shell_splats()
    assert shell is not None and len(shell) > 0 and not target.workspace.contains(shell.centers).any()
    return shell


def seen(step: int, block: float = 0.0, x: float = 0.1) -> list[RgbdFrame]:
    at = {"block": block, "block_x": ACROSS}
    return [frame(step * 100_000_000, x=s * x, camera=f"cam{i}", **at) for i, s in enumerate((1, -1))]


def run(target: SceneFitter, blocks: list[float]) -> SceneFitter:
    for block in blocks:
        target.step(seen(target.num_steps, block))
    return target


def outside(view: RgbdFrame) -> Bool:
    return ~REACH.contains(world_points(view))


def bytes_of(target: SceneFitter, *, shell: bool) -> dict[str, bytes]:
    return {
        name: array.tobytes() for name, array in fitter_state(target).items() if name.startswith("shell/") == shell
    }


def test_a_map_has_the_same_bytes_beside_a_shell_where_a_block_comes_and_goes_across_its_border() -> None:
    """A shell forgets what a camera sees through."""
    with_shell, without = (run(fitter(has_shell=has), [0.0, 0.2, 0.2, 0.0, 0.0]) for has in (True, False))
    assert bytes_of(with_shell, shell=False) == bytes_of(without, shell=False) and without.shell_splats() is None
    assert len(shell_of(with_shell)) > 30 and not (shell_of(with_shell).centers[:, 2] > 0.1).any()


def test_what_lies_beyond_is_black_without_a_shell_and_shows_with_one() -> None:
    target, view = run(fitter(), [0.0, 0.0]), seen(1)[0]
    shell = shell_of(target)
    check_splats("shell", shell)
    far = outside(view) & (np.abs(world_points(view)[..., 0]) > 0.25)  # not beside the border, where the map leaks
    for splats, least, most in ((target.splats(), 0.0, 12.0), (target.splats().joined(shell), 20.0, 60.0)):
        error = render(splats, INTRINSICS, looking_down(0.1)).color - view.color / 255.0
        assert least < -10 * np.log10(np.mean(error[far] ** 2)) < most


def test_a_block_across_the_border_is_whole_in_the_map_within_and_in_the_shell_beyond() -> None:
    target, points = run(fitter(), [0.0, 0.2, 0.2, 0.2]), world_points(seen(3, 0.2)[0])
    shell, top = shell_of(target), points[..., 2] > 0.15
    within, past = top & REACH.contains(points), top & (points[..., 0] > ACROSS + 0.03)
    assert within.sum() > 100 and past.sum() > 50
    mapped = SplatTree(target.splats().centers, target.splats().radii, 1)
    assert not mapped.are_further(points[within], CONFIG.max_gap + 0.002).any()
    assert mapped.are_further(points[past], 0.005).all() and REACH.contains(target.splats().centers).all()
    assert int(((shell.centers[:, 2] > 0.15) & (shell.opacities > 0.3)).sum()) > 3


def test_pixels_that_are_not_valid_show_nothing_beyond_although_they_have_depth() -> None:
    """As the black corners of an undistorted image, where the depth of another lens is registered to it."""
    whole, valid = seen(0)[0], np.broadcast_to(np.arange(INTRINSICS.width) >= 20, (60, 80))
    view, all_of_it = (pixels_beyond(fitter().view(f), MIN_RANGE) for f in (replace(whole, valid=valid), whole))
    assert all_of_it[:, :20].any() and np.array_equal(view, all_of_it & valid)


def test_a_splat_of_the_shell_that_comes_within_reach_is_removed() -> None:
    """Also on the floor, which no view sees through."""
    target = run(fitter(), [0.0])
    moved = np.flatnonzero(target.shell.buffer.is_alive)[:5]
    target.shell.buffer.centers[moved] = np.column_stack([np.linspace(-0.15, 0.15, 5), np.zeros(5), np.zeros(5)])
    assert len(shell_of(run(target, [0.0]))) > 30


def test_a_camera_that_drives_along_keeps_the_border_where_it_is() -> None:
    """As on a base that moves: what it saw beyond stays, and the map has the same bytes all the way."""
    drives = [fitter(), fitter(has_shell=False)]
    for target in drives:
        for step, x in enumerate(np.linspace(-0.4, 0.4, 9)):
            target.step([frame(step * 100_000_000, x=float(x))])
    x = shell_of(drives[0]).centers[:, 0]
    assert (x > 0.3).sum() > 10 and (x < -0.3).sum() > 10
    assert bytes_of(drives[0], shell=False) == bytes_of(drives[1], shell=False)


def test_beside_a_robot_a_learned_background_stands_where_nothing_returned_depth() -> None:
    """Neither the map nor the shell stands there: not on black, and not with splats in the air."""
    target, view, sky = fitter(), frame(), np.s_[:, 55:]
    view.color[sky], view.depth[sky] = (40, 90, 160), 0.0
    link = RobotPosture(centers=np.array([[0.0, 0.0, 0.3]]), radii=np.array([0.05]), T_world_link=np.eye(4)[None])
    for _ in range(2):
        target.step([view], link)
    assert target.descent.background == pytest.approx((40 / 255, 90 / 255, 160 / 255))
    both = target.splats().joined(target.shell_splats() or target.splats())
    shown = render(both, INTRINSICS, looking_down()).before(target.descent.background or BLACK)
    assert np.abs(shown.color - view.color / 255.0)[:, 62:].max() < 0.1


def test_pixels_within_reach_too_near_mounted_or_without_depth_are_not_beyond() -> None:
    target, view = fitter(), seen(0)[0]
    view.depth[:4], view.depth[4:8] = 0.0, 0.5 * MIN_RANGE
    mounted = np.broadcast_to(np.arange(INTRINSICS.width) < 5, view.depth.shape)
    target.mounted = {view.camera: mounted}
    found = pixels_beyond(target.view(view), MIN_RANGE, mounted)
    assert found.any() and not found[:8].any() and not found[:, :5].any()
    assert np.array_equal(found[8:, 5:], outside(view)[8:, 5:])


def test_the_shell_has_a_budget_of_its_own() -> None:
    target = fitter(shell=0.02)
    for blocks in ([0.0], [0.2, 0.0]):
        assert 20 < len(shell_of(run(target, blocks))) <= 30


def test_a_shell_begins_again_where_much_more_comes_into_view() -> None:
    """Or all its splats lie on the little that the first frames showed."""
    target, little = fitter(), frame()
    little.depth[outside(little) & (np.arange(INTRINSICS.width) > 2)] = 0.0
    target.step([little])
    assert (shell_of(target).centers[:, 0] < -0.4).all() and len(shell_of(target)) > 20
    assert (shell_of(run(target, [0.0, 0.0])).centers[:, 0] > 0.3).sum() > 20


def test_a_shell_has_the_same_bytes_at_any_thread_count_and_after_a_restart() -> None:
    blocks = [0.0, 0.2, 0.2, 0.0]
    straight = bytes_of(run(fitter(), blocks), shell=True)
    assert straight == bytes_of(run(fitter(threads=3), blocks), shell=True)
    half, restored = run(fitter(), blocks[:2]), fitter()
    restore_fitter(restored, {name: array.copy() for name, array in fitter_state(half).items()})
    assert straight == bytes_of(run(restored, blocks[2:]), shell=True)


@pytest.mark.parametrize("changes", [{}, {"iterations_per_step": 0, "first_iterations": 0}])
def test_nothing_beyond_gives_no_shell(changes: dict[str, float]) -> None:
    """Nor do frames without depth, or a shell that may not be optimised."""
    small, target, lost = frame(), fitter(reach=WORKSPACE, **changes), fitter(**changes)
    small.depth[~WORKSPACE.contains(world_points(small))] = 0.0
    target.step([small])
    lost.step([frame()])
    assert len(target.shell_splats() or ()) == 0 < len(lost.shell_splats() or ())
