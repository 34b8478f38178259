"""What a replay may know of the scene at a time, and of space."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from experiments.problems import simulated_arm
from splatctrl_cli.config import Config, ControlConfig
from splatctrl_cli.control.audit import BallDistance, DistanceFunction
from splatctrl_cli.control.columns import Obstacle
from splatctrl_cli.control.near_space import Seen
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.formats.grid.npz_grid import read_npz, write_npz
from splatctrl_cli.jobs.replay.known_scene import KnownFields, KnownScene, fields_at, known_space, splat_fields
from splatctrl_cli.jobs.replay.state_pass import ReplayRecord, blocks_of
from splatctrl_cli.records import DistanceField, Float64, Index, UInt8
from splatctrl_cli.robot.self_model import ALWAYS
from splatctrl_cli.scene.posture import posture_of
from splatctrl_cli.voxels import SWEPT, EvidenceClass, VoxelState
from tests.cli.replay_desk import SECOND
from tests.jobs.replay.broken import beside_the_mount
from tests.jobs.stage import FAR, Stage, decisive, passing
from tests.plain import plain_grid, plain_splats
from tests.refused import expect_refusal
from tests.robot.shapes import held_part


def look_free(points: Float64) -> tuple[Index, UInt8]:
    """All space, seen free at time 0."""
    return np.zeros(len(points), np.int64), np.zeros(len(points), np.uint8)


def test_a_scene_is_known_from_its_latency_on_until_the_next_is() -> None:
    at = fields_at((150, 250), lambda index: index, lambda index: index)  # type: ignore[arg-type, return-value]
    assert [at(stamp) for stamp in (150, 249, 250, 10_000)] == [0, 0, 1, 1]
    expect_refusal("no map is known yet at stamp 149 ns", at, 149, error=NotEvaluableError)


def test_the_depth_of_a_time_is_the_newest_known_until_the_next_map_is() -> None:
    alone = KnownScene(at=lambda _: None, observed=None, first_ns=None, cameras=None, digests={})  # type: ignore[arg-type, return-value]
    assert alone.own_ns(5) == 5
    scene = replace(alone, stamps_ns=(0, 100, 200), known_ns=(90, 130, 290))
    assert [scene.own_ns(stamp) for stamp in (-10, 0, 39, 50, 150, 250)] == [80, 90, 129, 129, 180, 340]
    assert [scene.depth_ns(scene.own_ns(stamp)) for stamp in (0, 39, 50, 150, 250)] == [0, 0, 0, 100, 200]


@pytest.mark.parametrize(("stamp_ns", "age_s"), [(1 * SECOND, 2.0), (3 * SECOND, 0.0), (7 * SECOND, 4.0)])
def test_a_field_of_one_moment_is_as_old_as_it_is_far_off(stamp_ns: int, age_s: float) -> None:
    scene = KnownScene(
        at=lambda _: None,  # type: ignore[arg-type, return-value]
        observed=lambda points: np.ones(len(points), np.uint8),
        first_ns=None,
        cameras=None,
        digests={},
        moment_ns=3 * SECOND,
    )
    assert scene.age_s(stamp_ns) == pytest.approx(age_s)


def test_space_that_a_camera_saw_or_the_robot_was_in_is_known() -> None:
    shape = (3, 1, 1)
    seen, entity = np.reshape([4, 0, 0], shape), np.reshape([0, SWEPT, 0], shape)
    grid = plain_grid(shape, 0.1, 0.0, log_odds=0.0, num_updates=seen, entity=entity)
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [9.0, 0, 0]])
    assert known_space(grid)(points).tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize(
    ("free", "has_come"), [((1, 0, 0, 0), True), ((0, 0, 0, 0), False), ((0, 0, None, None), False)]
)
def test_an_obstacle_comes_to_a_fixed_link_where_space_was_free_before(
    free: Sequence[int | None], has_come: bool
) -> None:
    """In space that was never free, splats fill a hole of the map instead. None: a map without states."""
    model, q = simulated_arm(), np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785])
    place, radius = beside_the_mount(model)
    far = (2.0, 2.0, 2.0)
    before, after = (splat_fields(plain_splats(centers, radius), Config(), 1) for centers in ([far], [far, place]))

    def seen_at(stamp_ns: int) -> Seen:
        now = free[stamp_ns // SECOND]
        is_free = None if now is None else np.full((1, 1, 1), bool(now))
        return Seen(look=look_free, origin=np.array(place), voxel=0.1, is_free=is_free)

    scene = KnownScene(
        at=lambda stamp_ns: (before, replace(before), after, replace(after))[stamp_ns // SECOND],
        observed=None,
        first_ns=None,
        cameras=None,
        digests={},
        seen_at=seen_at,
    )
    record = ReplayRecord(model, scene, config=Config(), max_map_age=9.0, is_continuous=False)
    for second in range(4):
        record.measure_block(np.array([second * SECOND]), q[None], np.zeros((1, 7)))
    first, least = record.fixed_parts.clearances["link0[0]"]
    assert first > 0.1
    assert least == (pytest.approx(-0.01, abs=0.03) if has_come else first)


def fields_of(distance: DistanceFunction, barrier: DistanceField) -> KnownFields:
    """A scene of one distance whose obstacles have no place."""
    nothing = Obstacle(distance=1.0, position=(np.nan, np.nan, np.nan))
    return KnownFields(
        barrier=barrier,
        distances={"exact": distance, "barrier": distance},
        median_radius=0.01,
        obstacles=lambda points: (nothing,) * len(points),
        splats_alone=distance,
    )


@pytest.mark.parametrize(
    ("heights", "depth_ms", "latency_ms", "first_ms", "shares"),
    [
        pytest.param((0.3, 0.2), 100, 0, 0, [0.0, 0.25, 0.5, 0.75, 1.0], id="what comes nearer is met on its way"),
        pytest.param((0.2, 0.3), 100, 0, 0, [0.0, 0.0, 0.0, 0.0, 1.0], id="what leaves stays until it is seen gone"),
        pytest.param((0.3, 0.2), 500, 0, 0, [0.0, 0.05, 0.1, 0.15, 0.2], id="half a second apart"),
        pytest.param((0.3, 0.2), 600, 0, 200, [0.0, 0.0, 0.0, 0.0, 0.0], id="too far apart"),
        pytest.param((0.3, 0.2), 100, 20, 20, [0.0, 0.0, 0.0, 0.0, 1.0], id="a late map is as the robot knew it"),
    ],
)
def test_an_object_comes_nearer_evenly_between_two_maps(
    heights: tuple[float, float], depth_ms: int, latency_ms: int, first_ms: int, shares: list[float]
) -> None:
    """Balls below the hand in the maps of two times; states each 25 ms from first_ms on."""
    model, q = simulated_arm(), np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785])
    hand, unit = model.sphere_centers(q)[-1], SECOND // 1000
    moving = model.moving_spheres
    balls = [SphereField(Spheres.of((hand - high * np.eye(3)[2])[None], np.array([1e-6]))) for high in heights]
    maps = [fields_of(lambda points, ball=ball: ball.query(points)[0], ball) for ball in balls]  # type: ignore[misc]
    stamps_ns = (0, depth_ms * unit)
    known_ns = tuple(stamp + latency_ms * unit for stamp in stamps_ns)
    scene = KnownScene(
        at=lambda stamp: maps[int(stamp >= known_ns[1])],
        observed=None,
        first_ns=None,
        cameras=None,
        digests={},
        stamps_ns=stamps_ns,
        known_ns=known_ns,
    )
    record = ReplayRecord(model, scene, config=Config(control=ControlConfig(margin=0.5)), max_map_age=1.0)
    stamps = first_ms * unit + np.arange(5) * SECOND // 40
    for first, last in blocks_of(scene, model, stamps):
        record.measure_block(stamps[first:last], np.tile(q, (last - first, 1)), np.zeros((last - first, 7)))
    far, near = (min((ball.query(model.sphere_centers(q))[0] - model.sphere_set.radii)[moving]) for ball in balls)
    expected = far + np.array(shares) * (near - far)
    assert record.trace["clearance_exact"] == pytest.approx(expected, abs=1e-6)
    assert record.trace["clearance_splats"] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("is_continuous", [True, False])
def test_the_space_about_the_arm_is_asked_between_states_that_are_far_apart(is_continuous: bool) -> None:
    """A tenth of a second in which the hand sweeps through a lost edge that neither state is near."""
    model, q, turn = simulated_arm(), np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785]), 0.3 * np.eye(7)[0]
    edge = model.sphere_centers(q)[-1]
    fields = fields_of(away, Away())
    seen = Seen(
        look=look_free,
        edges=np.array([[*edge, 1e-3]]),
    )
    scene = KnownScene(
        at=lambda _: fields, observed=None, first_ns=None, cameras=None, digests={}, seen_at=lambda _: seen
    )
    record = ReplayRecord(model, scene, config=Config(), max_map_age=1.0, is_continuous=is_continuous)
    record.measure_block(np.array([0, SECOND // 10]), np.array([q - turn, q + turn]), np.zeros((2, 7)))
    first, second = record.trace["class_distance"][:, EvidenceClass.DEPTH_EDGE]
    assert first > 0.02
    assert (second == 0.0) if is_continuous else (second > 0.02)
    place = record.trace["class_places"][1].reshape(-1, 3)[EvidenceClass.DEPTH_EDGE]
    assert np.isinf(second) or place == pytest.approx(edge)


def test_what_spheres_leave_uncovered_is_not_taken_from_a_surface_that_is_measured() -> None:
    """A ball 30 cm before the hand of an arm that triangles draw, whose spheres leave 5 cm uncovered."""
    arm, q = simulated_arm(), np.array([[0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785]])
    link = arm.sphere_set.links[-1]
    ball_at_hand = np.asarray(trimesh.creation.icosphere(radius=0.02).triangles)
    drawn = arm.join_self_model(held_part(link, ball_at_hand, *ALWAYS))
    model = drawn._change(sphere_deficit=np.where(np.array(arm.sphere_set.links) == link, 0.05, 0.0))
    center = model.sphere_centers(q[0])[-1] + [0.0, 0.0, -0.3]
    ball = SphereField(Spheres.of(center[None], np.array([0.01])))
    scene = BallDistance(of_points=lambda points: ball.query(points)[0], centers=center[None], radii=np.array([0.01]))
    fields = fields_of(scene, ball)
    known = KnownScene(at=lambda _: fields, observed=None, first_ns=None, cameras=None, digests={})
    record = ReplayRecord(model, known, config=Config(), max_map_age=1.0)
    record.measure_block(np.array([0]), q, np.zeros((1, 7)))
    gap = model.surface_gaps(q, scene.centers, scene.radii)[link][0]
    assert record.trace["clearance_exact"][0] == pytest.approx(gap)
    assert record.trace["clearance_surface"][0] == pytest.approx(gap)


def test_a_thing_that_the_hand_holds_for_a_time_counts_while_it_is_held() -> None:
    """A ball 30 cm below the hand; from 0.25 to 0.55 s the hand holds one of 2 cm, 10 cm below its own."""
    arm, q = simulated_arm(), np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785])
    link = arm.sphere_set.links[-1]
    hand = arm.sphere_centers(q)[-1]
    place = np.linalg.inv(arm.frame_pose(q, link)) @ [*hand - [0.0, 0.0, 0.1], 1.0]
    ball = trimesh.creation.icosphere(radius=0.02)
    base = arm.join_self_model(held_part(link, np.asarray(ball.triangles), *ALWAYS))
    model = base.join_self_model(held_part(link, ball.triangles + place[:3], SECOND // 4, 55 * SECOND // 100))
    scene = BallDistance(of_points=away, centers=(hand - [0.0, 0.0, 0.3])[None], radii=np.array([0.01]))
    fields = fields_of(scene, Away())
    known = KnownScene(at=lambda _: fields, observed=None, first_ns=None, cameras=None, digests={})
    stamps = np.arange(8) * SECOND // 10
    record = ReplayRecord(model, known, config=Config(), max_map_age=1.0)
    assert [*blocks_of(known, model, stamps)] == [(0, 3), (3, 6), (6, 8)]
    for first, last in blocks_of(known, model, stamps):
        record.measure_block(stamps[first:last], np.tile(q, (last - first, 1)), np.zeros((last - first, 7)))
    robots = (base, model.at(SECOND // 2))
    alone, holding = (robot.surface_gaps(q[None], scene.centers, scene.radii)[link][0] for robot in robots)
    assert holding == pytest.approx(0.17, abs=2e-3) and alone > 0.2
    assert record.trace["clearance_exact"] == pytest.approx([alone] * 3 + [holding] * 3 + [alone] * 2)
    posture = posture_of(model, q, dict.fromkeys(stamps.tolist(), q))
    counts = [len(posture.seen_at(stamp)[0].triangles) for stamp in stamps.tolist()]
    faces = len(ball.triangles)
    assert counts == [faces] * 3 + [2 * faces] * 3 + [faces] * 2
    assert posture.seen_at(int(stamps[3]))[0] is posture.seen_at(int(stamps[5]))[0]
    assert not posture_of(base, q, {0: q}).surfaces and base.at(0) is base


class Away:
    """One metre from everything."""

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        return away(points), np.zeros_like(points)


def away(points: Float64) -> Float64:
    return np.full(len(points), 1.0)


def test_what_a_field_never_saw_about_the_arm_is_judged_and_its_evidence_age_is_said_not_to_be(stage: Stage) -> None:
    stage.states = passing(np.array([1.8, 0, 0, 0, 0, 0, 0]))
    code, verdict = stage.judged_by_field(FAR, moment_ns=SECOND)
    assert (code, decisive(verdict)) == (0, {})
    assert "age of the evidence about the arm not judged" in verdict["sentence"] and verdict["how"] == ""
    code, asked = stage.replayed("--field", str(stage.desk.folder / "field"), "--require-proof")
    assert (code, decisive(asked)) == (5, {"known space": "not evaluable"})
    field = stage.desk.folder / "field"
    grid = read_npz(field / "field.npz")
    for state, channels in (
        (VoxelState.SWEPT_BY_ROBOT, {"observed": np.full_like(grid.channels["observed"], VoxelState.SWEPT_BY_ROBOT)}),
        (None, {}),
    ):
        kept = {name: values for name, values in grid.channels.items() if name != "observed"} | channels
        write_npz(field / "field.npz", replace(grid, channels=kept))
        code, verdict = stage.replayed("--field", str(field))
        assert (code, decisive(verdict)) == (5, {"known space": "not evaluable"})
        words = (
            "expected a record of the space that cameras saw"
            if state is None
            else "100 % of the space within the margin"
        )
        assert words in verdict["sentence"]
