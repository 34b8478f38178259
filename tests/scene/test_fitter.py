"""The fitter over a floor on which a block appears and leaves."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import SEED_ASKED_VIEWS, STEADY_GAIN
from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Box, Label, PointCloud, spread
from splatctrl_cli.scene.checkpoint import fitter_state, restore_fitter
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.posture import RobotPosture, carry_splats
from splatctrl_cli.scene.removal import REASONS
from splatctrl_cli.scene.render import render
from tests.refused import expect_refusal
from tests.scene.wall import INTRINSICS, WORKSPACE, frame, looking_down

CONFIG = SceneConfig(max_splats=1500, first_iterations=100, iterations_per_step=10)


def fitter(threads: int = 1, seed: int = 0, workspace: Box = WORKSPACE, **changes: int) -> SceneFitter:
    return SceneFitter(replace(CONFIG, **changes), OccupancyConfig(), workspace, seed=seed, threads=threads)  # type: ignore[arg-type]


def run(target: SceneFitter, blocks: list[float]) -> SceneFitter:
    for block in blocks:
        stamp = target.num_steps * 100_000_000
        target.step([frame(stamp, block=block, x=0.1), frame(stamp, block=block, x=-0.1, camera="cam1")])
    return target


def state_of(target: SceneFitter) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in fitter_state(target).items()}


def on_top(target: SceneFitter) -> int:
    """Splats on the top of the block."""
    splats = target.splats()
    return int(((splats.centers[:, 2] > 0.15) & (splats.opacities > 0.3)).sum())


def posture(x: float) -> RobotPosture:
    return RobotPosture(
        centers=np.array([[x, 0.0, 0.2]]), radii=np.array([0.12]), T_world_link=pose_at([x, 0.0, 0.0])[None]
    )


def test_a_floor_is_reconstructed_in_colour_and_depth() -> None:
    view = render(run(fitter(), [0.0] * 3).splats(), INTRINSICS, looking_down())
    inside = (slice(8, 52), slice(10, 68))
    assert np.median(np.abs(view.normalised_depth()[inside] - 1.0)) < 0.005
    assert -10 * np.log10(np.mean((view.color - frame().color / 255.0)[inside] ** 2)) > 26
    assert view.opacity[inside].mean() > 0.95


def test_a_block_is_in_the_map_while_it_is_there() -> None:
    target = fitter()
    counts = [on_top(run(target, blocks)) for blocks in ([0.0] * 2, [0.2] * 3, [0.0] * 5)]
    assert counts[0] == counts[2] == 0 and counts[1] > 30


BLOCKS = [0.0, 0.2, 0.2]


@pytest.fixture(scope="module")
def straight() -> dict[str, bytes]:
    return state_of(run(fitter(), BLOCKS))


def test_same_seed_gives_the_same_bytes_at_any_thread_count(straight: dict[str, bytes]) -> None:
    assert state_of(run(fitter(threads=3), BLOCKS)) == straight
    assert state_of(run(fitter(seed=1), BLOCKS))["parameters"] != straight["parameters"]


def test_a_restored_fitter_goes_on_to_the_same_bytes(straight: dict[str, bytes]) -> None:
    first, second = run(fitter(), BLOCKS[:2]), fitter()
    restore_fitter(second, {name: array.copy() for name, array in fitter_state(first).items()})
    assert state_of(run(second, BLOCKS[2:])) == straight


def test_depth_is_averaged_for_cameras_that_take_turns_and_after_a_restart() -> None:
    """Each time step has one camera's frame; the second of each camera is 1 mm farther than its first."""
    target, resumed = fitter(), fitter()
    for k in range(4):
        seen = frame(50_000_000 * k, x=0.1 * (-1) ** k, camera=f"cam{k % 2}")
        seen.depth[:] += 0.001 * (k // 2)
        if k == 3:
            restore_fitter(resumed, fitter_state(target))
            resumed.step([seen])
        target.step([seen])
    for view in (*target.window.newest, *resumed.window.newest):
        np.testing.assert_allclose(view.frame.depth, 1.0 + STEADY_GAIN * 0.001, atol=1e-6)
    assert len(target.window.newest) == len(resumed.window.newest) == 2


@pytest.mark.parametrize("budget", [1, 7, 300])
def test_the_budget_is_never_exceeded_and_the_audit_adds_up(budget: int) -> None:
    target, alive = fitter(max_splats=budget), 0
    for k, block in enumerate([0.0, 0.2, 0.2, 0.0]):
        row = target.step([frame(k, block=block)])
        alive += row.added + row.relocated - sum(row.removed.values())
        assert row.alive == alive == len(target.splats()) <= budget and list(row.removed) == list(REASONS)


def test_splats_inside_the_robot_are_its_own_and_the_table_under_it_is_not() -> None:
    """And none stays behind when it leaves."""
    target = fitter()
    for k in range(3):
        target.step([frame(k, block=0.2)], posture(0.0))
    splats = target.splats()
    height = splats.centers[:, 2]
    assert (splats.labels[height > 0.15] == Label.ROBOT).mean() > 0.5
    assert (splats.labels[height < 0.03] == Label.OBJECT).all()
    for k in range(3, 8):
        target.step([frame(k)], posture(0.8))
    assert on_top(target) == 0


def test_robot_splats_move_with_their_link() -> None:
    points = np.float32([[0.0, 0.0, 0.32], [0.12, 0.0, 0.2]])
    assert np.allclose(
        carry_splats(points, posture(0.0), posture(0.05)), points + np.float32([0.05, 0.0, 0.0]), atol=1e-6
    )


def test_voxels_smaller_than_the_largest_radius_are_refused() -> None:
    expect_refusal(
        r"occupancy.voxel: expected at least scene.max_radius",
        SceneFitter,
        CONFIG,
        OccupancyConfig(voxel=0.01),
        WORKSPACE,
        error=UsageError,
    )


def test_refining_a_scene_that_stands_still_improves_it_and_is_audited() -> None:
    target, done = fitter(), []
    before = target.step([frame(k, block=0.2, x=x, camera="camera") for k, x in enumerate((-0.1, 0.0, 0.1))])
    row = target.refine(155, done.append)
    assert done == [15, 31, 46, 62, 77, 93, 108, 124, 139, 155]
    assert row.psnr > before.psnr
    assert row.alive == len(target.splats()) == before.alive + row.added + row.relocated - sum(row.removed.values())


def test_what_one_camera_measures_and_another_sees_through_is_not_mapped() -> None:
    both, alone, noisy = fitter(), fitter(), frame(x=0.1)
    noisy.depth[25:35, 25:35] = 0.6
    both.step([noisy, frame(x=-0.1, camera="cam1")])
    alone.step([noisy])
    assert on_top(both) == 0 and on_top(alone) > 5


AWAY = RobotPosture(centers=np.array([[5.0, 0.0, 0.2]]), radii=np.array([0.12]), T_world_link=np.eye(4)[None])


@pytest.mark.parametrize("x", [0.03, 0.0])
def test_a_robot_that_moves_keeps_its_splats(x: float) -> None:
    target = fitter()
    target.step([frame(0, block=0.2)], posture(0.0))
    is_robot = target.buffer.labels == Label.ROBOT
    before = target.buffer.centers[is_robot, 0].mean()
    target._carry(posture(x))
    assert abs(target.buffer.centers[is_robot, 0].mean() - before - x) < 1e-4


@pytest.mark.parametrize("is_dark", [False, True])
def test_a_robot_that_jumps_leaves_no_splats(is_dark: bool) -> None:
    """Its link did not move: measured depth supports what was the robot, and without depth it is a trail."""
    target, seen = fitter(), frame(1, block=0.2)
    target.step([frame(0, block=0.2)], posture(0.0))
    seen.depth[:] *= not is_dark
    row = target.step([seen], AWAY)
    assert row.robot == 0 and (row.removed["trail"] > 0) is is_dark
    assert is_dark or on_top(target) > 30


def test_a_blank_or_sparse_start_costs_no_quality() -> None:
    blank, speck, scores = frame(0), frame(0), []
    blank.depth[:] = speck.depth[:] = 0.0
    speck.depth[28:33, 38:43] = 1.0
    for first in ([], [blank], [speck]):
        target = fitter()
        scores.append([target.step([seen]) for seen in (*first, frame(1), frame(2))][-1].psnr)
    assert min(scores[1:]) > scores[0] - 2.0


def test_no_splat_ends_outside_the_workspace() -> None:
    """And a view of nothing has no score."""
    low = replace(WORKSPACE, upper=np.array([0.45, 0.35, 0.175]))
    assert low.contains(run(fitter(workspace=low), [0.17] * 4).splats().centers).all()
    row = fitter(workspace=replace(WORKSPACE, lower=WORKSPACE.lower + 9, upper=WORKSPACE.upper + 9)).step([frame()])
    assert row.psnr is None and row.loss is None


def test_rates_fall_as_they_are_told() -> None:
    descent = fitter().descent
    full, low = descent.settings(), descent.settings(0.1, 0.5)
    for name, share in (("lr_color", 0.1), ("noise", 0.1), ("lr_center", 0.5), ("lr_log_radius", 0.5)):
        assert getattr(low, name) == pytest.approx(share * getattr(full, name))
    assert full.regulariser == CONFIG.lambda_reg  # nothing alive yet: one share


def test_a_splat_that_drifts_into_the_air_is_gone_after_the_next_step() -> None:
    """Within one voxel of the floor: only the image can tell."""
    target = fitter()
    target.step([frame(0)])
    target.buffer.centers[np.flatnonzero(target.buffer.is_alive)[:20], 2] = 0.019
    assert target.step([frame(1)]).removed["seen_through"] >= 10 and target.splats().centers[:, 2].max() < 0.019


def test_colour_cameras_alone_fit_planted_points() -> None:
    """Without depth, what is idle becomes clones."""
    y, x = np.mgrid[-0.3:0.3:40j, -0.4:0.4:50j].reshape(2, -1)
    points, target = np.stack([x, y, np.zeros_like(x)], 1).astype(np.float32), fitter()
    planted = target.plant(PointCloud(points=points, colors=np.full((len(points), 3), 0.5, np.float32)))
    assert planted.added == len(target.splats()) > 100
    views = [frame(k, x=x, camera="camera") for k, x in enumerate((-0.1, 0.0, 0.1))]
    before = target.step([replace(view, depth=np.zeros_like(view.depth)) for view in views])
    assert before.added == 0 and before.psnr is not None and before.psnr > 15.0
    assert np.abs(target.splats().centers[:, 2]).max() < 0.05
    row = target.refine(40)
    assert row.relocated > 0 and row.alive > before.alive


def test_what_the_optimiser_moves_off_the_robot_in_the_first_time_step_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    target = fitter()

    def sink(*_: object, **__: object) -> dict[int, object]:
        """Move the seeds on the robot down into the block, where no camera sees through them."""
        x, y, z = target.buffer.centers.T
        target.buffer.centers[(z > 0.15) & (np.hypot(x, y) < 0.09), 2] = 0.03
        return {}

    monkeypatch.setattr(target.descent, "run", sink)
    assert target.step([frame(0, block=0.2)], posture(0.0)).removed["robot"] > 0
    x, y, z = target.splats().centers.T
    assert not ((np.hypot(x, y) < 0.09) & (np.abs(z - 0.03) < 1e-6)).any()


def test_what_only_a_view_that_was_not_asked_sees_through_is_not_seeded() -> None:
    """One of 20 views shows a block; those that are asked have no depth there, the rest see the floor."""
    views = [frame(0, block=0.2), *(frame(0) for _ in range(19))]
    is_block = views[0].depth < 0.9
    for index in spread(range(20), SEED_ASKED_VIEWS)[1:]:
        views[index].depth[is_block] = 0.0
    row = fitter(first_iterations=0).step(views)
    assert row.alive > 100 and row.removed["seen_through"] == 0
