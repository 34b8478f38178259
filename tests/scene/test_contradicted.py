"""Rays through what another camera measures: into a shiny thing that is measured behind its place, or a dark one."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import CONTRADICTED
from splatctrl_cli.records import Float32, RgbdFrame
from splatctrl_cli.scene.contradicted import contradicted, without_contradicted
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask, object_mask
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


def masks_of(*frames: RgbdFrame) -> list[tuple[RgbdFrame, SelfMask]]:
    return [(seen, object_mask(seen)) for seen in frames]


@pytest.mark.parametrize(("behind", "is_wrong"), [(CONTRADICTED + 0.02, True), (CONTRADICTED - 0.02, False)])
def test_depth_far_behind_what_another_camera_measures_is_contradicted(behind: float, is_wrong: bool) -> None:
    """The floor about it shows through a pixel of the block that lies under the floor."""
    shiny, other = block_measured_at(HEIGHT + behind), frame(x=BESIDE, camera="cam1")
    found, none = contradicted(masks_of(shiny, other), is_drawn=False)
    is_block = shiny.depth > HEIGHT
    assert not none.until.any()
    pixels = found.pixels(shiny.depth.shape)
    assert pixels.any() == is_wrong and not (pixels & ~is_block).any()
    assert not is_wrong or pixels.sum() > 0.7 * is_block.sum()
    mask = without_contradicted(object_mask(shiny), found)
    assert ((mask.kinds == PixelKind.CONTRADICTED) == pixels).all()
    points = found.points(shiny, CONFIG, is_blank=False)
    assert bool(len(points)) == is_wrong and not len(found.points(shiny, CONFIG, is_blank=True))
    if is_wrong:  # on the rays of the block and above the floor
        assert (points[:, 2] > 0).all() and np.abs(points[:, :2]).max() < 0.12
        assert HEIGHT - CONFIG.min_range - 0.01 < points[:, 2].max() <= HEIGHT - CONFIG.min_range


def test_a_ray_proves_nothing_free_where_another_camera_sees_through_what_it_measures() -> None:
    """A block is measured in the air behind which the other camera sees the floor."""
    shiny, other = block_measured_at(0.6), frame(x=BESIDE, camera="cam1")
    found, beside = contradicted(masks_of(shiny, other), is_drawn=False)
    is_block = shiny.depth < HEIGHT
    proving = found.unproven(shiny)
    is_unproven = (proving.depth == 0) & (shiny.depth > 0)
    assert is_unproven.sum() > 0.5 * is_block.sum() and not found.until.any()
    assert not found.pixels(shiny.depth.shape).any()  # what it measures stays a surface of the map
    points = found.points(shiny, CONFIG, is_blank=False)
    assert HEIGHT - 0.6 - 1e-6 <= points[:, 2].min() < HEIGHT - 0.6 + CONFIG.voxel
    assert beside.until.any() and beside.unproven(other) is other


@pytest.mark.parametrize(("side", "is_noise"), [(5, True), (6, False)])
def test_fewer_than_sixteen_pixels_seen_through_within_their_outline_are_noise(side: int, is_noise: bool) -> None:
    """What lies beside their outline does not count."""
    floating, other = frame(), frame(x=BESIDE, camera="cam1")
    floating.depth[30 : 30 + side, 40 : 40 + side] = 0.6
    found, _ = contradicted(masks_of(floating, other), is_drawn=False)
    assert found.through.any() != is_noise


def test_a_camera_without_depth_makes_no_surface_doubtful() -> None:
    dark, other = block_measured_at(0.0), frame(x=BESIDE, camera="cam1")
    _, beside = contradicted(masks_of(dark, other), is_drawn=False)
    assert not beside.through.any()


def test_a_camera_without_depth_where_another_measures_a_surface_looked_in_vain() -> None:
    dark, other = block_measured_at(0.0), frame(x=BESIDE, camera="cam1")
    found, _ = contradicted(masks_of(dark, other), is_drawn=False)
    points = found.points(dark, CONFIG, is_blank=True)
    assert len(points) and not found.pixels(dark.depth.shape).any()
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
    """At 0.4 rad a pixel of the floor lies 4 cm behind its neighbour."""
    found, _ = contradicted(masks_of(block_measured_at(0.0), grazing(angle, 1.2)), is_drawn=False)
    is_blank = found.is_blank & (found.until > 0)
    assert is_blank.sum() > 0.5 * found.is_blank.sum()


def test_depth_beside_a_step_is_no_surface() -> None:
    """Each pixel of the ribs is beside one: it may show either height."""
    ribbed, dark = frame(x=BESIDE, camera="cam1"), block_measured_at(0.0)
    ribbed.depth[:, 0::4] += 0.05
    ribbed.depth[:, 1::4] += 0.05
    found, _ = contradicted(masks_of(dark, ribbed), is_drawn=False)
    assert found.is_blank.any() and not found.until.any()


def test_where_no_camera_has_depth_nothing_is_missing() -> None:
    """Of a black strip of the floor none returns any."""
    one, other = frame(), frame(x=BESIDE, camera="cam1")
    shift = round(BESIDE * INTRINSICS.fx / HEIGHT)
    one.depth[:, 30:60] = other.depth[:, 30 - shift : 60 - shift] = 0.0
    assert not any(found.until.any() for found in contradicted(masks_of(one, other), is_drawn=False))


@pytest.mark.parametrize(("side", "is_noise"), [(3, True), (4, False)])
def test_fewer_than_four_pixels_within_their_outline_are_noise(side: int, is_noise: bool) -> None:
    shiny, other = frame(), frame(x=BESIDE, camera="cam1")
    shiny.depth[30 : 30 + side, 40 : 40 + side] = HEIGHT + 0.3
    found, _ = contradicted(masks_of(shiny, other), is_drawn=False)
    assert found.until.any() != is_noise


def drawn(depth: Float32) -> SelfMask:
    """A robot half a metre before the camera in its block's place, of which only some returned depth."""
    mask = object_mask(block_measured_at(depth=0.0))
    robot = np.where(block_measured_at(0.0).depth <= 0, np.float32(0.5), np.float32(0.0))
    return replace(mask, robot_depth=robot)


@pytest.mark.parametrize("is_drawn", [True, False])
def test_a_robot_that_returns_no_depth_is_hidden_by_something(is_drawn: bool) -> None:
    dark = block_measured_at(0.0)
    (found,) = contradicted([(dark, drawn(dark.depth))], is_drawn=is_drawn)
    points = found.points(dark, CONFIG, is_blank=True)
    assert bool(len(points)) == is_drawn
    assert not is_drawn or points[:, 2].min() > HEIGHT - 0.5 - 1e-6


def test_a_lone_camera_contradicts_nothing() -> None:
    (found,) = contradicted(masks_of(block_measured_at(HEIGHT + 0.3)), is_drawn=True)
    assert not found.until.any()


@pytest.mark.parametrize(
    ("depth", "kind"), [(HEIGHT + 0.3, EvidenceClass.CONTRADICTED), (0.0, EvidenceClass.UNANSWERED)]
)
def test_a_fitted_scene_knows_it(depth: float, kind: EvidenceClass) -> None:
    """A camera beside it sees past the block's foot alone, and the block's inside is not free."""
    fitter = SceneFitter(SceneConfig(max_splats=300, first_iterations=1, iterations_per_step=1), CONFIG, WORKSPACE)
    fitter.step([block_measured_at(depth), frame(x=BESIDE, y=0.3, camera="cam1")])
    _, classes = fitter.known_voxels().seen.look(np.array([[0.0, 0.0, 0.4]]))
    assert classes.tolist() == [kind]


def test_a_fitted_scene_proves_nothing_free_by_a_ray_whose_end_another_camera_sees_through() -> None:
    fitter = SceneFitter(SceneConfig(max_splats=300, first_iterations=1, iterations_per_step=1), CONFIG, WORKSPACE)
    fitter.step([block_measured_at(0.7), frame(x=BESIDE, y=0.3, camera="cam1")])
    before = np.array([[0.0, 0.045, 0.58], [0.0, -0.045, 0.58]])  # on rays to the block; the other sees past one end
    _, classes = fitter.known_voxels().seen.look(before)
    assert classes.tolist() == [EvidenceClass.CONTRADICTED, EvidenceClass.FREE]
