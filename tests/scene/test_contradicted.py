"""Rays through what another camera measures: into a shiny thing that is measured behind its place, or a dark one."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import CONTRADICTED
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.contradicted import Contradicted, find_contradicted, mark_contradicted
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.self_mask import PixelKind, object_mask
from splatctrl_cli.voxels import EvidenceClass
from tests.plain import plain_frame
from tests.scene.wall import HEIGHT, INTRINSICS, WORKSPACE, frame

CONFIG = OccupancyConfig()
BLOCK = 0.1  # [m] high, 0.2 m wide
BESIDE = 0.15  # [m] from one camera to the other


def block_measured_at(depth: float, *, x: float = 0.0, camera: str = "cam0") -> RgbdFrame:
    """The floor and a block on it, of which a camera measures another depth."""
    seen = frame(block=BLOCK, x=x, camera=camera)
    seen.depth[seen.depth < HEIGHT] = depth
    return seen


def contradict_all(*frames: RgbdFrame) -> list[Contradicted]:
    """Return what the other frames contradict of each frame."""
    return [*find_contradicted([(seen, object_mask(seen)) for seen in frames], is_drawn=False)]


OTHER = frame(x=BESIDE, camera="cam1")


def points_of(found: Contradicted, its: RgbdFrame, *, is_blank: bool) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3)), *found.points(its, CONFIG, is_blank=is_blank)])


@pytest.mark.parametrize(("behind", "is_wrong"), [(CONTRADICTED + 0.02, True), (CONTRADICTED - 0.02, False)])
def test_depth_far_behind_what_another_camera_measures_is_contradicted(behind: float, is_wrong: bool) -> None:
    """The floor about it shows through a pixel of the block that lies under the floor."""
    shiny = block_measured_at(HEIGHT + behind)
    found, none = contradict_all(shiny, OTHER)
    is_block, pixels = shiny.depth > HEIGHT, found.pixels(shiny.depth.shape)
    assert not none.until.any() and not contradict_all(shiny)[0].until.any()  # nor does a lone camera
    assert pixels.any() == is_wrong and not (pixels & ~is_block).any()
    assert not is_wrong or pixels.sum() > 0.7 * is_block.sum()
    assert ((mark_contradicted(object_mask(shiny), found).kinds == PixelKind.CONTRADICTED) == pixels).all()
    points = points_of(found, shiny, is_blank=False)
    assert bool(len(points)) == is_wrong and not len(points_of(found, shiny, is_blank=True))
    if is_wrong:  # on the rays of the block and above the floor
        assert (points[:, 2] > 0).all() and np.abs(points[:, :2]).max() < 0.12
        assert HEIGHT - CONFIG.min_range - 0.01 < points[:, 2].max() <= HEIGHT - CONFIG.min_range


def test_a_ray_proves_nothing_free_where_another_camera_sees_through_what_it_measures() -> None:
    """A block is measured in the air behind which the other camera sees the floor."""
    shiny = block_measured_at(0.6)
    found, beside = contradict_all(shiny, OTHER)
    is_unproven = (found.unproven(shiny).depth == 0) & (shiny.depth > 0)
    assert is_unproven.sum() > 0.5 * (shiny.depth < HEIGHT).sum() and not found.until.any()
    assert not found.pixels(shiny.depth.shape).any()  # what it measures stays a surface of the map
    assert HEIGHT - 0.6 - 1e-6 <= points_of(found, shiny, is_blank=False)[:, 2].min() < HEIGHT - 0.6 + CONFIG.voxel
    assert beside.until.any() and beside.unproven(OTHER) is OTHER


@pytest.mark.parametrize(
    ("depth", "of", "side", "is_noise"),
    [
        *((0.6, "through", 5, True), (0.6, "through", 6, False)),  # what lies beside their outline does not count
        *((HEIGHT + 0.3, "until", 3, True), (HEIGHT + 0.3, "until", 4, False)),
    ],
)
def test_fewer_than_sixteen_pixels_seen_through_within_their_outline_are_noise(
    depth: float, of: str, side: int, is_noise: bool
) -> None:
    """And fewer than four that are contradicted."""
    floating = frame()
    floating.depth[30 : 30 + side, 40 : 40 + side] = depth
    assert getattr(contradict_all(floating, OTHER)[0], of).any() != is_noise


def test_a_camera_without_depth_where_another_measures_a_surface_looked_in_vain() -> None:
    """It makes no surface of the other's doubtful."""
    dark = block_measured_at(0.0)
    found, beside = contradict_all(dark, OTHER)
    points = points_of(found, dark, is_blank=True)
    assert len(points) and not found.pixels(dark.depth.shape).any() and not beside.through.any()
    assert np.linalg.norm(points - [0.0, 0.0, BLOCK / 2], axis=1).min() < CONFIG.voxel


def grazing(angle: float, away: float) -> RgbdFrame:
    """A camera that looks at the origin of the floor, `angle` [rad] above it and `away` [m] from it."""
    forward = np.array([0.0, np.cos(angle), -np.sin(angle)])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([[1.0, 0.0, 0.0], np.cross(forward, [1.0, 0.0, 0.0]), forward])
    T[:3, 3] = -away * forward
    v, _ = np.mgrid[: INTRINSICS.height, : INTRINSICS.width]
    down = -(T[2, 1] * (v - INTRINSICS.cy) / INTRINSICS.fy + T[2, 2])
    depth = np.where(down > 0.05, T[2, 3] / np.maximum(down, 0.05), 0).astype(np.float32)
    return plain_frame(depth, INTRINSICS, T, camera="cam1")


@pytest.mark.parametrize("angle", [np.pi / 2, 0.6, 0.4])
def test_a_floor_seen_at_any_angle_says_where_a_dark_block_returns_no_depth(angle: float) -> None:
    """The steepest step between two pixels of the floor is 4 cm at 0.4 rad."""
    found, _ = contradict_all(block_measured_at(0.0), grazing(angle, 1.2))
    assert (found.is_blank & (found.until > 0)).sum() > 0.5 * found.is_blank.sum()


def test_depth_beside_a_step_is_no_surface() -> None:
    """Each pixel of the ribs is beside one: it may show either height."""
    ribbed, dark = frame(x=BESIDE, camera="cam1"), block_measured_at(0.0)
    ribbed.depth[:, 0::4] += 0.05
    ribbed.depth[:, 1::4] += 0.05
    found, _ = contradict_all(dark, ribbed)
    assert found.is_blank.any() and not found.until.any()


def test_where_no_camera_has_depth_nothing_is_missing() -> None:
    """Of a black strip of the floor none returns any."""
    one, other = frame(), frame(x=BESIDE, camera="cam1")
    shift = round(BESIDE * INTRINSICS.fx / HEIGHT)
    one.depth[:, 30:60] = other.depth[:, 30 - shift : 60 - shift] = 0.0
    assert not any(found.until.any() for found in contradict_all(one, other))


@pytest.mark.parametrize("is_drawn", [True, False])
def test_a_robot_that_returns_no_depth_is_hidden_by_something(is_drawn: bool) -> None:
    """A robot half a metre before the camera in its block's place, of which only some returned depth."""
    dark = block_measured_at(0.0)
    mask = replace(object_mask(dark), robot_depth=np.where(dark.depth <= 0, np.float32(0.5), np.float32(0.0)))
    (found,) = find_contradicted([(dark, mask)], is_drawn=is_drawn)
    points = points_of(found, dark, is_blank=True)
    assert bool(len(points)) == is_drawn and (not is_drawn or points[:, 2].min() > HEIGHT - 0.5 - 1e-6)


@pytest.mark.parametrize(
    ("depth", "points", "kinds"),
    [
        (HEIGHT + 0.3, [[0.0, 0.0, 0.4]], [EvidenceClass.CONTRADICTED]),
        (0.0, [[0.0, 0.0, 0.4]], [EvidenceClass.UNANSWERED]),
        (0.7, [[0.0, 0.045, 0.58], [0.0, -0.045, 0.58]], [EvidenceClass.CONTRADICTED, EvidenceClass.FREE]),
    ],
)
def test_a_fitted_scene_knows_it(depth: float, points: list[list[float]], kinds: list[EvidenceClass]) -> None:
    """A camera beside it sees past the block's foot alone, and the block's inside is not free. Of two rays to the
    block the other camera sees past the end of one.
    """
    fitter = SceneFitter(SceneConfig(max_splats=300, first_iterations=1, iterations_per_step=1), CONFIG, WORKSPACE)
    fitter.step([block_measured_at(depth), frame(x=BESIDE, y=0.3, camera="cam1")])
    _, classes = fitter.known_voxels().seen.look(np.array(points))
    assert classes.tolist() == kinds
