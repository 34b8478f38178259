"""Which depth pixels are the robot's, on a ball (the robot) above a floor, beside, before and behind blocks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Box, Float64, Intrinsics, RgbdFrame, UInt8
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import Shape
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.self_mask import (
    PixelKind,
    SelfMask,
    audit_masks,
    drop_pixels,
    outvote_objects,
    self_mask,
    settle_pieces,
)
from tests.plain import plain_frame
from tests.reference.points import outvoted

K = Intrinsics(fx=160.0, fy=160.0, cx=79.5, cy=59.5, width=160, height=120)
FLOOR, CENTER, RADIUS = 1.2, np.array([0.0, 0.0, 0.9]), 0.1
CONFIG = OccupancyConfig()
TOLERANCE = CONFIG.self_mask_tolerance


def ball_depth(center: Float64 = CENTER, radius: float = RADIUS, k: Intrinsics = K) -> Float64:
    """Depth (H, W) of a ball, inf where there is none; the camera is the world."""
    v, u = np.mgrid[: k.height, : k.width]
    d = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    a, b, c = np.sum(d * d, axis=-1), d @ center, center @ center - radius**2
    root = b * b - a * c
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)


def frame(depth: Float64, k: Intrinsics = K) -> RgbdFrame:
    return plain_frame(np.minimum(depth, FLOOR), k, stamp_ns=5)


def masked(depth: Float64, posture: RobotPosture | None = None, k: Intrinsics = K) -> SelfMask:
    """Self-mask of a lone frame."""
    return self_mask(frame(depth, k), posture or robot(), CONFIG)


def robot(*, by_spheres: bool = False, extra: float = 0.0) -> RobotPosture:
    """A ball as collision geometry, or as the collision sphere of a robot without."""
    T = pose_at(CENTER)
    surface = RobotSurface.from_parts([Shape(link="arm", kind="sphere", size=(RADIUS,), T_link_shape=T)])
    return RobotPosture(
        centers=CENTER[None],
        radii=np.array([RADIUS + extra]),
        T_world_link=np.eye(4)[None],
        surface=None if by_spheres else surface,
        T_world_surface={} if by_spheres else {5: np.eye(4)[None]},
    )


def kinds(
    depth: Float64,
    posture: RobotPosture | None = None,
    others: Sequence[Float64] = (),
    config: OccupancyConfig = CONFIG,
) -> UInt8:
    """Settled by the depths of other frames."""
    views = [frame(each) for each in (depth, *others)]
    (view, mask), *beside = [(view, self_mask(view, posture or robot(), config)) for view in views]
    return settle_pieces(view, mask, beside, config).kinds


SHOWN = np.isfinite(ball_depth())


def test_the_robot_is_what_its_surface_explains_and_the_floor_is_not() -> None:
    assert (kinds(ball_depth()) == np.where(SHOWN, PixelKind.ROBOT, PixelKind.OBJECT)).all()
    behind = masked(np.full(SHOWN.shape, FLOOR))  # what is seen behind the robot is not inside it
    assert behind.num_inside == {} and (behind.kinds == PixelKind.OBJECT).all()


@pytest.mark.parametrize("offset", [-0.9 * TOLERANCE, 0.9 * TOLERANCE])
def test_noise_and_calibration_within_the_stated_tolerance_are_still_the_robot(offset: float) -> None:
    noise = np.random.default_rng(0).normal(0.0, CONFIG.depth_error, SHOWN.shape)
    assert (kinds(ball_depth() + offset + noise)[SHOWN] == PixelKind.ROBOT).mean() > 0.98


@pytest.mark.parametrize("gap", [0.012, 0.03, 0.2])
def test_what_stands_before_the_robot_is_an_object_however_near(gap: float) -> None:
    depth = ball_depth()
    depth[54:66, 74:86] -= gap
    assert (kinds(depth)[54:66, 74:86] == PixelKind.OBJECT).all()


def test_what_touches_the_robot_from_the_side_is_an_object() -> None:
    beside = ball_depth(CENTER + np.array([0.15, 0.0, 0.0]), 0.05)
    found = kinds(np.minimum(ball_depth(), beside))[np.isfinite(beside) & ~SHOWN]
    assert len(found) > 150 and (found == PixelKind.OBJECT).mean() > 0.9


def test_an_outline_that_is_off_by_the_tolerance_leaves_no_rim_of_objects() -> None:
    shifted = ball_depth(CENTER + np.array([0.8 * TOLERANCE, 0.0, 0.0]))
    found = kinds(shifted)[np.isfinite(shifted)]
    assert not (found == PixelKind.OBJECT).any() and (found == PixelKind.ROBOT).mean() > 0.98


def test_a_depth_between_the_robot_and_the_floor_at_its_outline_is_mixed_and_left_out() -> None:
    depth, edge = np.minimum(ball_depth(), FLOOR), SHOWN & ~np.roll(SHOWN, 1, axis=1)  # the left rim
    depth[edge] = 1.08
    mask = masked(depth)
    assert (mask.kinds[edge] == PixelKind.MIXED).all()
    left = drop_pixels(frame(depth), mask, PixelKind.MIXED).depth
    assert not left[edge].any() and left[~SHOWN].all()


def test_an_outline_just_outside_of_the_image_has_its_fat_edge_inside() -> None:
    right = K.fx * RADIUS / np.sqrt(CENTER[2] ** 2 - RADIUS**2)  # pixels from the ball's centre to its outline
    k, depth = replace(K, cx=-1.5 - right), np.full(SHOWN.shape, FLOOR)
    assert not np.isfinite(ball_depth(k=k)).any()
    depth[57:63, :2] = CENTER[2]
    found = masked(depth, k=k).kinds
    assert not (found[57:63, :2] == PixelKind.OBJECT).any() and (found[:, 4:] == PixelKind.OBJECT).all()


@pytest.mark.parametrize(("columns", "kind"), [(1, PixelKind.MIXED), (2, PixelKind.MIXED), (3, PixelKind.OBJECT)])
def test_what_is_behind_the_outline_counts_where_it_shows_beyond_the_width_of_an_edge(
    columns: int, kind: PixelKind
) -> None:
    """The first pixel beside the robot is an edge's; each is 34 mm^2."""
    depth = np.where(SHOWN, ball_depth(), 0.0)  # nothing else returns a depth
    end = np.flatnonzero(SHOWN[60])[0]
    depth[60, end - columns : end] = CENTER[2] + 0.03
    assert (kinds(depth)[60, end - columns : end] == kind).all()


def test_a_doubted_pixel_is_not_confirmed_by_a_view_of_its_neighbour_behind() -> None:
    """Two doubted pixels touch by a corner, 30 cm apart in depth; another frame measured the farther one alone."""
    depth, kinds = np.zeros(SHOWN.shape), np.zeros(SHOWN.shape, np.uint8)
    near, far = (60, 60), (61, 61)
    depth[near], depth[far] = 0.9, 1.2
    kinds[near] = kinds[far] = PixelKind.DOUBTED
    mask = replace(masked(depth), kinds=kinds)
    other, seen = np.where(depth == 1.2, depth, 0.0), np.where(depth == 1.2, kinds, 0).astype(np.uint8)
    decided = settle_pieces(frame(depth), mask, [(frame(other), replace(mask, kinds=seen))], CONFIG).kinds
    assert (decided[near], decided[far]) == (PixelKind.MIXED, PixelKind.OBJECT)


def test_depths_that_lie_between_the_robot_and_what_is_behind_are_no_part_of_either() -> None:
    """As a laser returns them at an outline, each another one, beside a surface that goes on."""
    depth, rim = np.minimum(ball_depth(), FLOOR), SHOWN ^ np.isfinite(ball_depth(radius=RADIUS + 0.006))
    depth[rim] = 0.93 + 0.22 * np.random.default_rng(0).random(rim.sum())
    found = kinds(depth)[rim]
    assert (found == PixelKind.MIXED).mean() > 0.8
    kept = depth[rim][found == PixelKind.OBJECT]
    assert (kept > FLOOR - 0.06).all()  # as near to the floor as neighbours of one surface may be


WIDE = Intrinsics(fx=640.0, fy=640.0, cx=319.5, cy=239.5, width=640, height=480)


def before_a_wide_floor() -> tuple[Float64, int]:
    """Depth (H, W) of the ball and the floor, and the ball's first column in its middle row."""
    depth = np.minimum(ball_depth(k=WIDE), FLOOR)
    return depth, int(np.argmax(depth[240] < FLOOR))


@pytest.mark.parametrize("before", [0.02, 0.05])
def test_a_rod_that_goes_on_beyond_the_outline_is_an_object_up_to_it(before: float) -> None:
    """6 mm thick, before a floor with the sensor's noise: the plane beside the outline takes none of it."""
    depth, left = before_a_wide_floor()
    depth[239:242, left - 60 : left] = FLOOR - before
    noise = np.random.default_rng(0).normal(0.0, CONFIG.depth_error, depth.shape)
    mask = self_mask(plain_frame(depth + noise * depth**2, WIDE, stamp_ns=5), robot(), CONFIG)
    assert (mask.kinds[239:242, left - 60 : left - 1] == PixelKind.OBJECT).mean() > 0.97


@pytest.mark.parametrize("lift", [0.017, 0.0])
def test_pixels_on_the_outline_that_lead_from_the_robot_down_to_the_floor_are_no_part_of_it(lift: float) -> None:
    """17 mm from one to the next."""
    depth, first = before_a_wide_floor()
    depth[239:241, first - 1] = FLOOR - 2.0 * lift, FLOOR - lift
    found = masked(depth, k=WIDE).kinds
    assert (found[239:241, first - 1] == (PixelKind.MIXED if lift else PixelKind.OBJECT)).all()
    assert (found == PixelKind.MIXED).sum() == (2 if lift else 0)


def before_a_box(fixed: tuple[str, ...] = ()) -> tuple[Float64, RobotPosture]:
    """Depth (H, W) of a floor and a robot's box before it: 0.8 m in rows 160 to 320, columns 240 to 400."""
    box = trimesh.creation.box((0.2, 0.2, 0.2)).triangles + CENTER
    depth = np.full((WIDE.height, WIDE.width), FLOOR)
    depth[160:320, 240:400] = 0.8
    return depth, replace(robot(), surface=RobotSurface.from_parts([], [("arm", box)], fixed=fixed))


def test_depths_between_an_object_and_the_robot_behind_it_belong_to_neither() -> None:
    """Two rows of pixels that a laser mixes, above a block 60 mm before the robot; a slope is a surface."""
    mixed, posture = before_a_box()
    slope, block = mixed.copy(), np.s_[240:300, 290:350]
    mixed[block] = 0.74
    mixed[238:240, 290:350] = np.random.default_rng(0).uniform(0.765, 0.785, (2, 60))
    found = masked(mixed, posture, WIDE).kinds
    assert (found[238:240, 290:350] == PixelKind.MIXED).all() and (found[block] == PixelKind.OBJECT).all()
    slope[block] = np.linspace(0.785, 0.74, 60)[:, None]
    assert (masked(slope, posture, WIDE).kinds[block] == PixelKind.OBJECT).all()


@pytest.mark.parametrize(("depth", "fixed", "kind"), [
    (0.788, ("arm",), PixelKind.MIXED), (0.788, (), PixelKind.OBJECT), (0.7, ("arm",), PixelKind.OBJECT),
])  # fmt: skip
def test_a_table_ends_at_the_outline_of_a_fixed_link_that_stands_on_it(
    depth: float, fixed: tuple[str, ...], kind: PixelKind
) -> None:
    """Noise lifts the table and the foot: what is before the foot is an object of its own, or none."""
    lifted, posture = before_a_box(fixed)
    lifted[310:400, 280:360] = depth
    found = masked(lifted, posture, WIDE).kinds
    assert (found[311:319, 282:358] == kind).all() and (found[320:400, 280:360] == PixelKind.OBJECT).all()


@pytest.mark.parametrize(("columns", "kind"), [(1, PixelKind.MIXED), (2, PixelKind.MIXED), (3, PixelKind.OBJECT)])
def test_less_than_fifty_square_millimetres_before_the_robot_are_noise(columns: int, kind: PixelKind) -> None:
    """Beside the robot it may be all that is seen of a thing."""
    depth, piece = ball_depth(), np.s_[60, 79 : 79 + columns]
    depth[piece] += [0.012, -0.012, -0.012][columns - 1]
    depth[20, 20] = 0.8
    found = kinds(depth)
    assert (found[piece] == kind).all() and found[20, 20] == PixelKind.OBJECT
    assert (found[SHOWN] == PixelKind.ROBOT).sum() == SHOWN.sum() - columns


@pytest.mark.parametrize(("side", "gap", "earlier", "kind"), [
    (3, 0.03, 0.0, PixelKind.MIXED), (3, 0.03, 0.03, PixelKind.OBJECT), (5, 0.03, 0.0, PixelKind.OBJECT),
])  # fmt: skip
def test_a_little_before_the_robot_counts_where_another_frame_measured_it_too(
    side: int, gap: float, earlier: float, kind: PixelKind
) -> None:
    now, before, piece = ball_depth(), ball_depth(), np.s_[60 : 60 + side, 79 : 79 + side]
    now[piece] -= gap
    before[piece] -= earlier
    assert (kinds(now, others=[before])[piece] == kind).all()
    assert (kinds(now)[piece] == PixelKind.OBJECT).all()  # nothing that could have shown it


@pytest.mark.parametrize("others", [[], [ball_depth()]])
def test_the_tip_of_a_surface_that_comes_from_elsewhere_is_no_speck(others: list[Float64]) -> None:
    """One column of pixels just so near to the rim that a piece may be a speck; with others six pixels, 190 mm^2."""
    column = int(np.flatnonzero(SHOWN[60])[0]) - 4
    rows = slice(61, 67) if others else slice(61, 62)
    tip, whole = (np.where(SHOWN, ball_depth(), 0.0) for _ in range(2))  # nothing else returns a depth
    tip[rows, column] = whole[rows, : column + 1] = CENTER[2]
    assert (kinds(tip, others=others)[rows, column] == PixelKind.MIXED).all()
    assert (kinds(whole, others=others)[rows, column] == PixelKind.OBJECT).all()


def shown(own: Sequence[int], depth: float = 1.0) -> tuple[RgbdFrame, SelfMask]:
    """A frame of one surface; the kinds, in order, of 16 pixels about its middle, which lie in one voxel of 10 cm."""
    pixels = np.full((K.height, K.width), PixelKind.NOTHING, np.uint8)
    pixels[58:62, 78:82] = np.reshape(own, (4, 4))
    rendered = np.where(pixels == PixelKind.ROBOT, np.float32(depth), np.float32(0.0))
    return frame(np.full((K.height, K.width), depth)), SelfMask(
        kinds=pixels, robot_depth=rendered, residuals={}, num_inside={}
    )


ROBOT, OBJECT = [PixelKind.ROBOT], [PixelKind.OBJECT]


@pytest.mark.parametrize(
    ("frames", "num_objects"),
    [
        pytest.param([14 * ROBOT + 2 * OBJECT], 0, id="2 of 14"),
        pytest.param([13 * ROBOT + 3 * OBJECT], 3, id="3 of 13: a rod of 6 mm has more"),
        pytest.param([12 * ROBOT + 4 * OBJECT, 16 * ROBOT], 0, id="two cameras vote together"),
        pytest.param([16 * OBJECT], 16, id="no robot"),
    ],
)
def test_few_object_pixels_in_a_voxel_of_the_robot_are_outvoted(frames: list[list[int]], num_objects: int) -> None:
    seen = [shown(own) for own in frames]
    for mask, (_, own) in zip(outvote_objects(seen, np.array([0.0, 0.0, 1.0]), 0.1), seen, strict=True):
        is_object = own.kinds == PixelKind.OBJECT
        assert ((mask.kinds == PixelKind.OBJECT) == (is_object & (num_objects > 0))).all()
        assert ((mask.kinds == PixelKind.MIXED) == (is_object & (num_objects == 0))).all()


def test_the_robots_votes_count_in_their_own_voxel_alone() -> None:
    robot, beside = shown(16 * ROBOT), shown(16 * OBJECT, depth=1.11)
    assert (outvote_objects([robot, beside], np.array([0.0, 0.0, 1.0]), 0.1)[1].kinds == beside[1].kinds).all()
    assert not (
        outvote_objects([robot, beside], np.array([0.0, 0.0, 1.1]), 0.3)[1].kinds == PixelKind.MIXED
    ).any()  # 16 to 16


def test_the_votes_of_random_pixels_are_those_of_the_reference() -> None:
    """Two cameras; all object pixels are near enough to the robot's to vote."""
    rng, seen = np.random.default_rng(2), []
    for turn in (0.0, 0.2):
        kinds = rng.choice(4 * [PixelKind.NOTHING] + OBJECT + 7 * ROBOT, (K.height, K.width)).astype(np.uint8)
        view = frame(rng.uniform(0.9, 1.1, kinds.shape))
        T = pose_at([turn, 0.0, 0.0], Rotation.from_euler("y", turn).as_matrix())
        mask = SelfMask(
            kinds=kinds,
            robot_depth=np.where(kinds == PixelKind.ROBOT, view.depth, np.float32(0.0)),
            residuals={},
            num_inside={},
        )
        seen.append((replace(view, T_world_camera=T), mask))
    robots, objects = ([mask.kinds == kind for _, mask in seen] for kind in (PixelKind.ROBOT, PixelKind.OBJECT))
    origin = np.array([0.013, 0.0, 1.0])
    expected = outvoted([view for view, _ in seen], robots, objects, origin, 0.1, fixed.VOTE_SHARE)
    for (_, mask), found, lost in zip(seen, outvote_objects(seen, origin, 0.1), expected, strict=True):
        assert (found.kinds == np.where(lost, PixelKind.MIXED, mask.kinds)).all()
        assert 100 < lost.sum() < 0.9 * (mask.kinds == PixelKind.OBJECT).sum()


def drawn() -> RobotPosture:
    """The ball as triangles."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return replace(robot(), surface=RobotSurface.from_parts([], [("arm", ball.triangles + CENTER)]))


@pytest.mark.parametrize(("posture", "kind"), [(robot(), PixelKind.OBJECT), (drawn(), PixelKind.ROBOT)])
def test_what_is_seen_through_a_slit_is_robot_where_triangles_are_there(posture: RobotPosture, kind: int) -> None:
    depth = ball_depth()
    depth[50:70, 79:82] = CENTER[2] + RADIUS - 0.01  # the inner side of the back
    assert (kinds(depth, posture)[52:68, 79:82] == kind).all()


@pytest.mark.parametrize(("gap", "is_object"), [(0.012, False), (0.03, True)])
def test_before_a_mesh_what_noise_may_explain_is_evidence_of_nothing(gap: float, is_object: bool) -> None:
    config = replace(CONFIG, depth_error=0.004)  # twice of it 5 mm, four times 10 mm
    depth = ball_depth()
    depth[54:66, 74:86] -= gap
    found = kinds(depth, drawn(), config=config)[54:66, 74:86]
    assert ((found == PixelKind.OBJECT) == is_object).all() and (found == PixelKind.MIXED).any() != is_object


def test_points_inside_the_robot_are_counted_by_link_and_are_no_robot() -> None:
    depth = ball_depth()
    depth[55:65, 75:85] += 0.05
    mask = masked(depth)
    assert (mask.kinds[55:65, 75:85] == PixelKind.OBJECT).all() and mask.num_inside == {"arm": 100}


@pytest.mark.parametrize("offset", [-0.02, -0.004, 0.004, 0.02])
def test_the_residual_has_the_median_and_sign_of_the_offset(offset: float) -> None:
    found = audit_masks([masked(ball_depth() + offset)] * 2)["self_mask"]["arm"]
    assert (found["median_mm"], found["sign"]) == (pytest.approx(1e3 * offset, abs=0.2), np.sign(offset))
    assert found["num_pixels"] > 2 * 500


@pytest.mark.parametrize("offset", [-0.25, 0.25])
def test_what_is_seen_far_before_or_behind_the_robot_says_nothing_of_its_residual(offset: float) -> None:
    depth = ball_depth()
    depth[:, :90] += offset  # most of the ball
    assert audit_masks([masked(depth)])["self_mask"]["arm"]["median_mm"] == pytest.approx(0.0, abs=0.2)


def test_a_link_is_told_apart_as_well_as_by_the_best_of_its_cameras() -> None:
    """Within 4 mm and two sigmas of the sensor's error at its depth, and nothing nearer."""
    coarse = replace(CONFIG, self_mask_tolerance=0.05)
    masks = [self_mask(frame(ball_depth()), robot(), config) for config in (coarse, CONFIG)]
    depth = np.median(masks[0].robot_depth[masks[0].robot_depth > 0])
    want = CONFIG.self_mask_tolerance + 2 * CONFIG.depth_error * depth**2
    assert masks[0].reach > masks[1].reach == pytest.approx(want, rel=0.01)
    assert audit_masks(masks)["self_mask"]["arm"]["reach_mm"] == round(1e3 * masks[1].reach, 2)


@pytest.mark.parametrize("extra", [0.0, 0.05])
def test_spheres_that_stand_for_a_link_enclose_it(extra: float) -> None:
    """They may be larger than the link by any amount: what lies inside them is the robot."""
    before, posture = ball_depth(), robot(by_spheres=True, extra=extra)
    assert (kinds(before, posture)[np.isfinite(ball_depth(radius=0.09))] == PixelKind.ROBOT).all()
    before[50:70, 70:90] -= 0.1
    assert (kinds(before, posture)[50:70, 70:90] == PixelKind.OBJECT).all()


def test_a_carried_box_is_the_robots() -> None:
    """Its content need not fill the box."""
    depth, posture = np.minimum(ball_depth(), FLOOR), robot()
    depth[100:110, 70:90] = 1.0
    assert posture.surface is not None and (kinds(depth)[100:110, 70:90] == PixelKind.OBJECT).all()
    at_frame = {5: np.tile(np.eye(4), (2, 1, 1))}  # the link's pose, and the box's
    for near in (1.0, 0.95):
        held = Box(lower=np.array([-0.1, 0.2, near]), upper=np.array([0.1, 0.4, 1.1]))
        holding = replace(posture, surface=posture.surface.add_boxes([("arm", held)]), T_world_surface=at_frame)
        assert (kinds(depth, holding)[101:109, 71:89] == PixelKind.ROBOT).all()


def test_beside_a_nearer_link_depth_that_has_grown_over_a_link_is_not_its_residual() -> None:
    """Stereo gives the rim of what is behind the depth of what is before."""
    plates = (("near", (0.0, 0.0, 0.8)), ("far", (0.08, 0.0, 0.9)))
    solids = [Shape(link=link, kind="box", size=(0.1, 0.1, 0.01), T_link_shape=pose_at(at)) for link, at in plates]
    posture = replace(
        robot(), surface=RobotSurface.from_parts(solids), T_world_surface={5: np.tile(np.eye(4), (2, 1, 1))}
    )
    exact = masked(np.full(SHOWN.shape, np.inf), posture).robot_depth
    depth = np.where(exact > 0, exact, FLOOR)
    left = int(np.flatnonzero((exact > 0.85).any(axis=0))[0])
    depth[:, left : left + 2] = np.where(exact[:, left : left + 2] > 0, 0.795, depth[:, left : left + 2])
    found = masked(depth, posture).residuals
    assert len(found["far"]) > 20 and np.abs(found["far"]).max() < 1e-3


def test_a_board_before_a_link_is_not_its_residual_and_a_displaced_link_is() -> None:
    """The board is 4 to 14 cm before the ball; the displaced ball is 7 cm nearer than its joints say."""
    ball, before = ball_depth(), np.broadcast_to(np.linspace(0.14, 0.04, 36), (120, 36))
    board = ball.copy()
    board[:, 62:98] = np.where(SHOWN[:, 62:98], ball[:, 62:98] - before, FLOOR)
    assert not len(masked(board).residuals.get("arm", ()))
    half = np.where(np.arange(160) < 80, board, ball)
    assert len(masked(half).residuals["arm"]) > 100 and np.abs(masked(half).residuals["arm"]).max() < 1e-3
    assert np.median(masked(np.where(SHOWN, ball - 0.07, FLOOR)).residuals["arm"]) == pytest.approx(-0.07, abs=1e-3)
    corner = np.where((np.arange(160) < 66) & SHOWN, ball - 0.2, np.where(SHOWN, ball - 0.07, FLOOR))
    assert np.median(masked(corner).residuals["arm"]) == pytest.approx(-0.07, abs=1e-3)  # few pixels occlude little
