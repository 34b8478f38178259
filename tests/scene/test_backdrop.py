"""The backdrop of a block with depth before a coloured wall without."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.geometry import back_project_pixels
from splatctrl_cli.records import Box, Intrinsics, Label, RgbdFrame
from splatctrl_cli.scene.backdrop import backdrop_seeds
from splatctrl_cli.scene.buffer import Seeds
from splatctrl_cli.scene.checkpoint import fitter_state, restore_fitter
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.render import BLACK

LENS = Intrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
WALL, BLOCK = 2.0, 1.0  # [m], depth of either
TILE = 0.12  # [m], width of the wall's tiles, some of them black
WORKSPACE = Box(lower=np.array([-0.4, -0.4, 0.8]), upper=np.array([0.4, 0.4, 1.2]))
MOST = 200


def view(x: float, stamp_ns: int = 0) -> RgbdFrame:
    """Frame of a camera at (x, 0, 0), looking along z: a red block of 30 cm, with depth, before the wall."""
    v, u = np.mgrid[: LENS.height, : LENS.width]
    wall = back_project_pixels(LENS, u, v, np.full(u.shape, WALL))
    color = np.random.default_rng(3).integers(0, 256, (64, 64, 3), np.uint8)
    color[::3] = 0
    row, column = (np.floor(at / TILE).astype(int) + 32 for at in (wall[..., 1], wall[..., 0] + x))
    color = color[row, column]
    block = back_project_pixels(LENS, u, v, np.full(u.shape, BLOCK))
    is_block = (np.abs(block[..., 0] + x) < 0.15) & (np.abs(block[..., 1]) < 0.15)
    color[is_block] = (200, 30, 30)
    pose = np.eye(4)
    pose[0, 3] = x
    depth = np.where(is_block, np.float32(BLOCK), np.float32(0.0))
    return RgbdFrame(
        camera="camera", stamp_ns=stamp_ns, color=color, depth=depth, intrinsics=LENS, T_world_camera=pose
    )


def views() -> list[RgbdFrame]:
    return [view(x, n) for n, x in enumerate(np.linspace(-0.3, 0.3, 7))]


def seeds_of(frames: list[RgbdFrame], most: int = MOST, shown: float = 0.0) -> Seeds:
    """Seeds before a black background, where the map shows `shown` of each pixel."""
    return backdrop_seeds(frames, [np.full(f.depth.shape, shown, np.float32) for f in frames], BLACK, most)


def test_seeds_lie_where_the_views_agree() -> None:
    """They are at most one step of depth off. Black tiles get none, as the background is black."""
    seeds = seeds_of(views(), 3000)
    z = seeds.centers[np.abs(seeds.centers[:, 0]) < 0.5, 2]  # in all views
    assert len(z) > 100 and np.median(np.abs(z - WALL)) < 0.2
    assert seeds.colors.mean(axis=1).min() > 0.03


def glare() -> list[RgbdFrame]:
    """A white plane at `BLOCK` with depth and a red disc; the first view has a white glare without depth for it."""
    found = []
    for n, x in enumerate((0.0, -0.2, -0.1, 0.1, 0.2)):
        frame = view(x, n)
        v, u = np.mgrid[: LENS.height, : LENS.width]
        plane = back_project_pixels(LENS, u, v, np.full(u.shape, BLOCK))
        is_disc = np.hypot(plane[..., 0] + x, plane[..., 1]) < 0.12
        color = np.full_like(frame.color, 255)
        color[is_disc & (n > 0)] = (200, 30, 30)
        depth = np.where(is_disc & (n == 0), np.float32(0.0), np.float32(BLOCK))
        found.append(replace(frame, color=color, depth=depth))
    return found


def test_no_seed_lies_before_measured_depth() -> None:
    """Though the white of the plane agrees with the glare in front of it."""
    seeds = seeds_of(glare())
    assert len(seeds) > 0 and seeds.centers[:, 2].min() > 0.95 * BLOCK


@pytest.mark.parametrize("most", [0, 5, 40])
def test_cells_grow_until_the_seeds_are_few_enough(most: int) -> None:
    assert len(seeds_of(views(), most)) <= most


def test_what_the_map_shows_needs_no_seed() -> None:
    assert len(seeds_of(views(), shown=1.0)) == 0


def test_views_without_any_depth_have_no_scale_to_place_a_backdrop() -> None:
    assert len(seeds_of([replace(frame, depth=np.zeros_like(frame.depth)) for frame in views()])) == 0


def fitted(*, has_backdrop: bool) -> SceneFitter:
    config = SceneConfig(max_splats=1500, first_iterations=60, refine_iterations=60, window=10, shell=0.3)
    fitter = SceneFitter(config, OccupancyConfig(), WORKSPACE, threads=1, has_backdrop=has_backdrop)
    fitter.step(views())
    fitter.refine(60)
    return fitter


def test_a_backdrop_is_rendered_beside_a_map_that_knows_nothing_of_it() -> None:
    """It is no surface: neither among the map's splats nor in its occupancy."""
    plain, behind = fitted(has_backdrop=False), fitted(has_backdrop=True)
    backdrop = behind.shell_splats()
    assert plain.shell_splats() is None
    assert WORKSPACE.contains(behind.splats().centers).all()
    assert len(behind.splats()) + len(backdrop) == np.count_nonzero(behind.buffer.is_alive)
    assert set(backdrop.labels.tolist()) == {Label.OBJECT}
    held_out = behind.view(view(0.05))
    errors = [fitter.descent.evaluate(held_out).squared for fitter in (plain, behind)]
    assert errors[1] < 0.75 * errors[0]


def test_a_resumed_fitter_keeps_its_backdrop() -> None:
    first = fitted(has_backdrop=True)
    second = SceneFitter(first.config, OccupancyConfig(), WORKSPACE, threads=1, has_backdrop=True)
    restore_fitter(second, fitter_state(first))
    kept, backdrop = first.shell_splats(), second.shell_splats()
    np.testing.assert_array_equal(backdrop.centers, kept.centers)
