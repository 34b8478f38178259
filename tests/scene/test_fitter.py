"""The fitter over a floor on which a block appears and leaves."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import SEED_ASKED_VIEWS, STEADY_GAIN
from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Label, PointCloud, SplatSet, spread
from splatctrl_cli.scene.checkpoint import fitter_state, restore_fitter
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.posture import RobotPosture, carried
from splatctrl_cli.scene.removal import REASONS
from splatctrl_cli.scene.render import render
from tests.scene.wall import INTRINSICS, WORKSPACE, frame, looking_down

CONFIG = SceneConfig(max_splats=1500, first_iterations=100, iterations_per_step=10)
OCCUPANCY = OccupancyConfig()


def fitter(threads: int = 1, seed: int = 0) -> SceneFitter:
    return SceneFitter(CONFIG, OCCUPANCY, WORKSPACE, seed=seed, threads=threads)


def run(target: SceneFitter, blocks: list[float], first: int = 0) -> None:
    for k, block in enumerate(blocks):
        stamp = (first + k) * 100_000_000
        target.step([frame(stamp, block=block, x=0.1), frame(stamp, block=block, x=-0.1, camera="cam1")])


def on_top(splats: SplatSet) -> int:
    """Splats on the top of the block."""
    return int(((splats.centers[:, 2] > 0.15) & (splats.opacities > 0.3)).sum())


def posture(x: float) -> RobotPosture:
    T = pose_at([x, 0.0, 0.0])
    return RobotPosture(centers=np.array([[x, 0.0, 0.2]]), radii=np.array([0.12]), T_world_link=T[None])


def test_a_floor_is_reconstructed_in_colour_and_depth() -> None:
    target = fitter()
    run(target, [0.0] * 3)
    view = render(target.splats(), INTRINSICS, looking_down())
    inside = (slice(8, 52), slice(10, 68))
    assert np.median(np.abs(view.normalised_depth()[inside] - 1.0)) < 0.005
    error = (view.color - frame().color / 255.0)[inside]
    assert -10 * np.log10(np.mean(error**2)) > 26
    assert view.opacity[inside].mean() > 0.95


def test_a_block_is_in_the_map_while_it_is_there() -> None:
    target = fitter()
    run(target, [0.0] * 2)
    assert on_top(target.splats()) == 0
    run(target, [0.2] * 3, first=2)
    assert on_top(target.splats()) > 30
    run(target, [0.0] * 5, first=5)
    assert on_top(target.splats()) == 0


def test_same_seed_gives_the_same_bytes_at_any_thread_count() -> None:
    results = []
    for threads in (1, 2, 3):
        target = fitter(threads)
        run(target, [0.0, 0.2, 0.2])
        results.append({name: array.tobytes() for name, array in fitter_state(target).items()})
    assert results[0] == results[1] == results[2]
    other = fitter(seed=1)
    run(other, [0.0, 0.2, 0.2])
    assert fitter_state(other)["parameters"].tobytes() != results[0]["parameters"]


def test_a_restored_fitter_goes_on_to_the_same_bytes() -> None:
    straight = fitter()
    run(straight, [0.0, 0.2, 0.2, 0.0])
    first = fitter()
    run(first, [0.0, 0.2])
    second = fitter()
    restore_fitter(second, {name: array.copy() for name, array in fitter_state(first).items()})
    run(second, [0.2, 0.0], first=2)
    a, b = fitter_state(straight), fitter_state(second)
    assert a.keys() == b.keys()
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)


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
    for one in (target, resumed):
        newest = {view.frame.camera: view.frame.depth for view in one.window.newest}
        for depth in (newest["cam0"], newest["cam1"]):
            np.testing.assert_allclose(depth, 1.0 + STEADY_GAIN * 0.001, atol=1e-6)


def test_the_budget_is_never_exceeded_and_the_audit_adds_up() -> None:
    target = SceneFitter(replace(CONFIG, max_splats=300), OCCUPANCY, WORKSPACE)
    alive = 0
    for k, block in enumerate([0.0, 0.2, 0.2, 0.0]):
        row = target.step([frame(k, block=block)])
        alive += row.added + row.relocated - sum(row.removed.values())
        assert row.alive == alive == len(target.splats()) <= 300
        assert list(asdict(row)["removed"]) == list(REASONS)


def test_splats_inside_the_robot_are_its_own_and_the_table_under_it_is_not() -> None:
    target = fitter()
    seen = [frame(k, block=0.2) for k in range(3)]
    for one in seen:
        target.step([one], posture(0.0))
    splats = target.splats()
    top = splats.centers[:, 2] > 0.15
    floor = splats.centers[:, 2] < 0.03
    assert (splats.labels[top] == Label.ROBOT).mean() > 0.5
    assert (splats.labels[floor] == Label.OBJECT).all()


def test_robot_splats_move_with_their_link() -> None:
    before, after = posture(0.0), posture(0.05)
    points = np.float32([[0.0, 0.0, 0.32], [0.12, 0.0, 0.2]])
    assert np.allclose(carried(points, before, after), points + np.float32([0.05, 0.0, 0.0]), atol=1e-6)


def test_no_splat_of_a_robot_that_left_stays_behind() -> None:
    target = fitter()
    target.step([frame(0, block=0.2)], posture(0.0))
    assert (target.splats().labels == Label.ROBOT).any()
    for k in range(1, 6):
        target.step([frame(k)], posture(0.8))
    assert on_top(target.splats()) == 0


def test_voxels_smaller_than_the_largest_radius_are_refused() -> None:
    with pytest.raises(UsageError, match=r"occupancy.voxel: expected at least scene.max_radius"):
        SceneFitter(CONFIG, OccupancyConfig(voxel=0.01), WORKSPACE)


def test_refining_a_scene_that_stands_still_improves_it_and_is_audited() -> None:
    target = fitter()
    views = [frame(k, block=0.2, x=x, camera="camera") for k, x in enumerate((-0.1, 0.0, 0.1))]
    before = target.step(views)
    done: list[int] = []
    row = target.refine(155, done.append)
    assert done == [15, 31, 46, 62, 77, 93, 108, 124, 139, 155]
    assert row.psnr > before.psnr
    assert row.alive == len(target.splats())
    assert row.alive == before.alive + row.added + row.relocated - sum(row.removed.values())


def test_what_one_camera_measures_and_another_sees_through_is_not_mapped() -> None:
    noisy, clean = frame(x=0.1), frame(x=-0.1, camera="cam1")
    noisy.depth[25:35, 25:35] = 0.6
    target = fitter()
    target.step([noisy, clean])
    assert on_top(target.splats()) == 0
    alone = fitter()
    alone.step([noisy])
    assert on_top(alone.splats()) > 5


def test_a_robot_that_moves_keeps_its_splats_and_one_that_jumps_leaves_none() -> None:
    moved, stayed = fitter(), fitter()
    for target, x in ((moved, 0.03), (stayed, 0.0)):
        target.step([frame(0, block=0.2)], posture(0.0))
        before = target.splats().centers[target.splats().labels == Label.ROBOT, 0].mean()
        target.config = replace(CONFIG, iterations_per_step=0)
        target._carry(posture(x))
        after = target.splats().centers[target.splats().labels == Label.ROBOT, 0].mean()
        assert abs(after - before - x) < 1e-4
    jumped = fitter()
    jumped.step([frame(0, block=0.2)], posture(0.0))
    away = RobotPosture(centers=np.array([[5.0, 0.0, 0.2]]), radii=np.array([0.12]), T_world_link=np.eye(4)[None])
    row = jumped.step([frame(1, block=0.2)], away)  # the link did not move, and its splats are where depth is
    assert row.removed["trail"] == row.robot == 0
    assert on_top(jumped.splats()) > 30, "measured depth supports what was the robot"
    hidden = fitter()
    hidden.step([frame(0, block=0.2)], posture(0.0))
    dark = frame(1)
    dark.depth[:] = 0.0
    row = hidden.step([dark], away)  # nothing shows them, and the robot is elsewhere: a trail
    assert row.removed["trail"] > 0
    assert row.robot == 0


def test_a_blank_or_sparse_start_costs_no_quality() -> None:
    straight, late, sparse = fitter(), fitter(), fitter()
    blank, speck = frame(0), frame(0)
    blank.depth[:] = 0.0
    speck.depth[:] = 0.0
    speck.depth[28:33, 38:43] = 1.0
    rows = []
    for target, first in ((straight, None), (late, blank), (sparse, speck)):
        if first is not None:
            target.step([first])
        rows.append([target.step([frame(k)]) for k in (1, 2)][-1])
    want = rows[0].psnr
    assert want is not None
    for row in rows[1:]:
        assert row.psnr is not None and row.psnr > want - 2.0


def test_a_view_of_nothing_has_no_score() -> None:
    target = SceneFitter(CONFIG, OCCUPANCY, replace(WORKSPACE, lower=WORKSPACE.lower + 9, upper=WORKSPACE.upper + 9))
    row = target.step([frame()])
    assert row.psnr is None
    assert row.loss is None


@pytest.mark.parametrize("budget", [1, 2, 7])
def test_a_tiny_budget_is_filled_not_exceeded(budget: int) -> None:
    target = SceneFitter(replace(CONFIG, max_splats=budget, first_iterations=2), OCCUPANCY, WORKSPACE)
    assert 0 <= target.step([frame()]).alive <= budget


def test_no_splat_ends_outside_the_workspace() -> None:
    low = replace(WORKSPACE, upper=np.array([0.45, 0.35, 0.175]))
    target = SceneFitter(CONFIG, OCCUPANCY, low)
    run(target, [0.17] * 4)
    assert low.contains(target.splats().centers).all()


def test_rates_fall_as_they_are_told() -> None:
    target = fitter()
    full, low = target.descent.settings(), target.descent.settings(0.1, 0.5)
    assert low.lr_color == pytest.approx(0.1 * full.lr_color)
    assert low.noise == pytest.approx(0.1 * full.noise)
    assert low.lr_center == pytest.approx(0.5 * full.lr_center)
    assert low.lr_log_radius == pytest.approx(0.5 * full.lr_log_radius)
    assert full.regulariser == CONFIG.lambda_reg  # nothing alive yet: one share


def test_a_splat_that_drifts_into_the_air_is_gone_after_the_next_step() -> None:
    target = fitter()
    target.step([frame(0)])
    lifted = np.flatnonzero(target.buffer.is_alive)[:20]
    target.buffer.centers[lifted, 2] = 0.019  # within one voxel of the floor: only the image can tell
    row = target.step([frame(1)])
    assert row.removed["seen_through"] >= 10
    assert target.splats().centers[:, 2].max() < 0.019


def test_colour_cameras_alone_fit_planted_points() -> None:
    seen = [frame(k, x=x, camera="camera") for k, x in enumerate((-0.1, 0.0, 0.1))]
    y, x = np.mgrid[-0.3:0.3:40j, -0.4:0.4:50j].reshape(2, -1)
    points = np.stack([x, y, np.zeros_like(x)], 1).astype(np.float32)
    target = fitter()
    planted = target.plant(PointCloud(points=points, colors=np.full((len(points), 3), 0.5, np.float32)))
    assert planted.added == len(target.splats()) > 100
    row = target.step([replace(view, depth=np.zeros_like(view.depth)) for view in seen])
    assert row.added == 0
    assert row.psnr is not None and row.psnr > 15.0
    assert np.abs(target.splats().centers[:, 2]).max() < 0.05
    before = row.alive
    row = target.refine(40)
    assert row.relocated > 0, "without depth, what is idle becomes clones"
    assert row.alive > before


def test_what_the_optimiser_moves_off_the_robot_in_the_first_time_step_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    target = fitter()

    def sink(*_: object, **__: object) -> dict[int, object]:
        """Move the seeds on the robot down into the block, where no camera sees through them."""
        centers = target.buffer.centers
        centers[(centers[:, 2] > 0.15) & (np.hypot(centers[:, 0], centers[:, 1]) < 0.09), 2] = 0.03
        return {}

    monkeypatch.setattr(target.descent, "run", sink)
    row = target.step([frame(0, block=0.2)], posture(0.0))
    assert row.removed["robot"] > 0
    centers = target.splats().centers
    assert not ((np.hypot(centers[:, 0], centers[:, 1]) < 0.09) & (np.abs(centers[:, 2] - 0.03) < 1e-6)).any()


def test_what_only_a_view_that_was_not_asked_sees_through_is_not_seeded() -> None:
    """One of 20 views shows a block; those that are asked have no depth there, the rest see the floor."""
    views = [frame(0, x=0.0) for _ in range(20)]
    views[0] = frame(0, block=0.2)
    is_block = frame(0, block=0.2).depth < frame(0).depth - 0.1
    for index in spread(range(20), SEED_ASKED_VIEWS)[1:]:
        views[index].depth[is_block] = 0.0
    row = SceneFitter(replace(CONFIG, first_iterations=0), OCCUPANCY, WORKSPACE).step(views)
    assert row.alive > 100
    assert row.removed["seen_through"] == 0
