"""What a replay may know of the scene at a time, and of space."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from experiments.problems import simulated_arm
from splatctrl_cli.config import Config, ControlConfig
from splatctrl_cli.control.audit import BallDistance
from splatctrl_cli.control.columns import Obstacle
from splatctrl_cli.control.near_space import Seen
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.formats.grid.npz_grid import read_npz, write_npz
from splatctrl_cli.jobs.replay.known_scene import KnownFields, KnownScene, fields_at, known_space, splat_fields
from splatctrl_cli.jobs.replay.state_pass import ReplayRecord, blocks_of
from splatctrl_cli.records import Float64, Index, UInt8
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_model import ALWAYS
from splatctrl_cli.scene.posture import posture_of
from splatctrl_cli.voxels import SWEPT, EvidenceClass, VoxelState
from tests.cli.replay_desk import SECOND
from tests.jobs.stage import Stage, beside_the_mount, decisive, passing
from tests.plain import plain_grid, plain_splats
from tests.refused import expect_refusal
from tests.robot.shapes import held_part

NOTHING = Obstacle(distance=1.0, position=(np.nan, np.nan, np.nan))
POSTURE = np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785])


def look_free(points: Float64) -> tuple[Index, UInt8]:
    """All space, seen free at time 0."""
    return np.zeros(len(points), np.int64), np.zeros(len(points), np.uint8)


def away(points: Float64) -> Float64:
    return np.full(len(points), 1.0)


class Away:
    """One metre from everything."""

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        return away(points), np.zeros_like(points)


def fields_of(distance: Any = away, barrier: Any = None) -> KnownFields:
    """Both fields with this distance; nothing is named as an obstacle."""
    return KnownFields(
        barrier=barrier or Away(),
        distances={"exact": distance, "barrier": distance},
        median_radius=0.01,
        obstacles=lambda points: (NOTHING,) * len(points),
        splats_alone=distance,
    )


def scene_of(at: Callable[[int], Any], **more: Any) -> KnownScene:
    """Fields by stamp, of which nothing more is known but what is given."""
    return KnownScene(**{"at": at, "observed": None, "first_ns": None, "cameras": None, "digests": {}} | more)


def recorded(model: RobotModel, scene: KnownScene, **more: bool) -> ReplayRecord:
    return ReplayRecord(model, scene, config=Config(), max_map_age=9.0, **more)


def test_a_scene_is_known_from_its_latency_on_until_the_next_is() -> None:
    at = fields_at((150, 250), lambda index: index, lambda index: index)  # type: ignore[arg-type, return-value]
    assert [at(stamp) for stamp in (150, 249, 250, 10_000)] == [0, 0, 1, 1]
    expect_refusal("no map is known yet at stamp 149 ns", at, 149, error=NotEvaluableError)


def test_the_depth_of_a_time_is_the_newest_known_until_the_next_map_is() -> None:
    alone = scene_of(lambda _: None)
    assert alone.own_ns(5) == 5
    scene = replace(alone, stamps_ns=(0, 100, 200), known_ns=(90, 130, 290))
    assert [scene.own_ns(stamp) for stamp in (-10, 0, 39, 50, 150, 250)] == [80, 90, 129, 129, 180, 340]
    assert [scene.depth_ns(scene.own_ns(stamp)) for stamp in (0, 39, 50, 150, 250)] == [0, 0, 0, 100, 200]


@pytest.mark.parametrize(("stamp_ns", "age_s"), [(1 * SECOND, 2.0), (3 * SECOND, 0.0), (7 * SECOND, 4.0)])
def test_a_field_of_one_moment_is_as_old_as_it_is_far_off(stamp_ns: int, age_s: float) -> None:
    scene = scene_of(lambda _: None, observed=lambda points: np.ones(len(points), np.uint8), moment_ns=3 * SECOND)
    assert scene.age_s(stamp_ns) == pytest.approx(age_s)


def test_space_that_a_camera_saw_or_the_robot_was_in_is_known() -> None:
    shape = (3, 1, 1)
    seen, entity = np.reshape([4, 0, 0], shape), np.reshape([0, SWEPT, 0], shape)
    grid = plain_grid(shape, 0.1, 0.0, log_odds=0.0, num_updates=seen, entity=entity)
    assert known_space(grid)(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [9.0, 0, 0]])).tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize(
    ("free", "has_come"), [((1, 0, 0, 0), True), ((0, 0, 0, 0), False), ((0, 0, None, None), False)]
)
def test_an_obstacle_comes_to_a_fixed_link_where_space_was_free_before(
    free: Sequence[int | None], has_come: bool
) -> None:
    """In space that was never free, splats fill a hole of the map instead. None: a map without states."""
    model = simulated_arm()
    place, radius = beside_the_mount(model)
    far = (2.0, 2.0, 2.0)
    before, after = (splat_fields(plain_splats(centers, radius), Config(), 1) for centers in ([far], [far, place]))

    def seen_at(stamp_ns: int) -> Seen:
        now = free[stamp_ns // SECOND]
        is_free = None if now is None else np.full((1, 1, 1), bool(now))
        return Seen(look=look_free, origin=np.array(place), voxel=0.1, is_free=is_free)

    in_turn = (before, replace(before), after, replace(after))
    record = recorded(
        model, scene_of(lambda stamp_ns: in_turn[stamp_ns // SECOND], seen_at=seen_at), is_continuous=False
    )
    for second in range(4):
        record.measure_block(np.array([second * SECOND]), POSTURE[None], np.zeros((1, 7)))
    first, least = record.fixed_parts.clearances["link0[0]"]
    assert first > 0.1
    assert least == (pytest.approx(-0.01, abs=0.03) if has_come else first)


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
    model, unit = simulated_arm(), SECOND // 1000
    centers, radii = (each[model.moving_spheres] for each in (model.sphere_centers(POSTURE), model.sphere_set.radii))
    balls = [SphereField(Spheres.of((centers[-1] - [0.0, 0.0, z])[None], np.array([1e-6]))) for z in heights]
    maps = [fields_of(lambda points, ball=ball: ball.query(points)[0], ball) for ball in balls]
    known_ns = (latency_ms * unit, (depth_ms + latency_ms) * unit)
    scene = scene_of(lambda stamp: maps[int(stamp >= known_ns[1])], stamps_ns=(0, depth_ms * unit), known_ns=known_ns)
    config = Config(control=ControlConfig(margin=0.5))
    record = ReplayRecord(model, scene, config=config, max_map_age=1.0)
    stamps = first_ms * unit + np.arange(5) * SECOND // 40
    for first, last in blocks_of(scene, model, stamps):
        record.measure_block(stamps[first:last], np.tile(POSTURE, (last - first, 1)), np.zeros((last - first, 7)))
    far, near = ((ball.query(centers)[0] - radii).min() for ball in balls)
    expected = far + np.array(shares) * (near - far)
    assert record.trace["clearance_exact"] == pytest.approx(expected, abs=1e-6)
    assert record.trace["clearance_splats"] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("is_continuous", [True, False])
def test_the_space_about_the_arm_is_asked_between_states_that_are_far_apart(is_continuous: bool) -> None:
    """A tenth of a second in which the hand sweeps through a lost edge that neither state is near."""
    model, turn = simulated_arm(), 0.3 * np.eye(7)[0]
    edge = model.sphere_centers(POSTURE)[-1]
    seen = Seen(look=look_free, edges=np.array([[*edge, 1e-3]]))
    fields = fields_of()
    record = recorded(model, scene_of(lambda _: fields, seen_at=lambda _: seen), is_continuous=is_continuous)
    record.measure_block(np.array([0, SECOND // 10]), np.array([POSTURE - turn, POSTURE + turn]), np.zeros((2, 7)))
    first, second = record.trace["class_distance"][:, EvidenceClass.DEPTH_EDGE]
    assert first > 0.02 and ((second == 0.0) if is_continuous else (second > 0.02))
    place = record.trace["class_places"][1].reshape(-1, 3)[EvidenceClass.DEPTH_EDGE]
    assert np.isinf(second) or place == pytest.approx(edge)


def test_what_spheres_leave_uncovered_is_not_taken_from_a_surface_that_is_measured() -> None:
    """A ball 30 cm before the hand of an arm that triangles draw, whose spheres leave 5 cm uncovered."""
    arm = simulated_arm()
    link = arm.sphere_set.links[-1]
    ball_at_hand = np.asarray(trimesh.creation.icosphere(radius=0.02).triangles)
    drawn = arm.join_self_model(held_part(link, ball_at_hand, *ALWAYS))
    model = drawn._change(sphere_deficit=np.where(np.array(arm.sphere_set.links) == link, 0.05, 0.0))
    centers, radii = model.sphere_centers(POSTURE)[-1:] - np.array([0.0, 0.0, 0.3]), np.array([0.01])
    ball = SphereField(Spheres.of(centers, radii))
    distance = BallDistance(of_points=lambda points: ball.query(points)[0], centers=centers, radii=radii)
    record = recorded(model, scene_of(lambda _: fields_of(distance, ball)))
    record.measure_block(np.array([0]), POSTURE[None], np.zeros((1, 7)))
    gap = pytest.approx(model.surface_gaps(POSTURE[None], centers, radii)[link][0])
    assert (record.trace["clearance_exact"][0], record.trace["clearance_surface"][0]) == (gap, gap)


def test_a_thing_that_the_hand_holds_for_a_time_counts_while_it_is_held() -> None:
    """A ball 30 cm below the hand; from 0.25 to 0.55 s the hand holds one of 2 cm, 10 cm below its own."""
    arm, q = simulated_arm(), POSTURE
    link, hand = arm.sphere_set.links[-1], arm.sphere_centers(q)[-1]
    place = np.linalg.inv(arm.frame_pose(q, link)) @ [*hand - [0.0, 0.0, 0.1], 1.0]
    ball = np.asarray(trimesh.creation.icosphere(radius=0.02).triangles)
    base = arm.join_self_model(held_part(link, ball, *ALWAYS))
    model = base.join_self_model(held_part(link, ball + place[:3], SECOND // 4, 55 * SECOND // 100))
    scene = BallDistance(of_points=away, centers=(hand - [0.0, 0.0, 0.3])[None], radii=np.array([0.01]))
    fields, stamps = fields_of(scene), np.arange(8) * SECOND // 10
    known = scene_of(lambda _: fields)
    record = recorded(model, known)
    blocks = [*blocks_of(known, model, stamps)]
    assert blocks == [(0, 3), (3, 6), (6, 8)]
    for first, last in blocks:
        record.measure_block(stamps[first:last], np.tile(q, (last - first, 1)), np.zeros((last - first, 7)))
    robots = (base, model.at(SECOND // 2))
    alone, holding = (robot.surface_gaps(q[None], scene.centers, scene.radii)[link][0] for robot in robots)
    assert holding == pytest.approx(0.17, abs=2e-3) and alone > 0.2
    assert record.trace["clearance_exact"] == pytest.approx([alone] * 3 + [holding] * 3 + [alone] * 2)
    posture = posture_of(model, q, dict.fromkeys(stamps.tolist(), q))
    counts = [len(posture.seen_at(stamp)[0].triangles) for stamp in stamps.tolist()]
    assert counts == [len(ball) * num for num in (1, 1, 1, 2, 2, 2, 1, 1)]
    assert posture.seen_at(int(stamps[3]))[0] is posture.seen_at(int(stamps[5]))[0]
    assert not posture_of(base, q, {0: q}).surfaces and base.at(0) is base


def test_what_a_field_never_saw_about_the_arm_is_judged_and_its_evidence_age_is_said_not_to_be(stage: Stage) -> None:
    stage.states, stage.baked = passing(np.array([1.8, 0, 0, 0, 0, 0, 0])), {"moment_ns": SECOND}
    verdict = stage.expect(0, {}, says="age of the evidence about the arm not judged")
    assert verdict["how"] == ""
    field = stage.desk.folder / "field"
    grid = read_npz(field / "field.npz")
    swept = {"observed": np.full_like(grid.channels["observed"], VoxelState.SWEPT_BY_ROBOT)}
    bare = {name: values for name, values in grid.channels.items() if name != "observed"}
    for channels, options, words in (
        (grid.channels, ["--require-proof"], ""),
        (bare | swept, [], "100 % of the space within the margin"),
        (bare, [], "expected a record of the space that cameras saw"),
    ):
        write_npz(field / "field.npz", replace(grid, channels=channels))
        code, verdict = stage.replayed("--field", str(field), *options)
        assert (code, decisive(verdict)) == (5, {"known space": "not evaluable"}) and words in verdict["sentence"]
