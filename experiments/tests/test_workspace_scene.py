"""The shared workspace: capsules that hang together as an arm, touch only cubes, and are what masks show."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from experiments import shared_workspace
from experiments.__main__ import main
from experiments.shared_workspace import PLACES, human_arm, task_motion, things, visit_of
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions
from splatctrl_cli.simulate.truth import distance_to, load_truth

SEEDS = range(3)


def axis_of(solid: Primitive, stamp_ns: int) -> Float64:
    """Nine places along a capsule's axis, ends included."""
    local = np.linspace(-solid.size[1] / 2, solid.size[1] / 2, 9)[:, None] * np.array([0.0, 0.0, 1.0])
    return transform_points(solid.at(stamp_ns).T_world_shape, local)


@pytest.mark.parametrize("place", PLACES)
def test_the_links_of_the_arm_hang_together_while_it_moves(place: str) -> None:
    visit = visit_of(place, 1)
    upper, fore, hand = human_arm(visit, START_NS)
    hands = []
    for second in np.arange(visit.start_s + 0.01, visit.end_s, 0.037):
        stamp = START_NS + int(second * 1e9)
        assert all(solid.is_present(stamp) for solid in (upper, fore, hand))
        np.testing.assert_allclose(axis_of(upper, stamp)[0], visit.shoulder, atol=5e-3)  # knots 50 ms apart
        np.testing.assert_allclose(axis_of(upper, stamp)[-1], axis_of(fore, stamp)[0], atol=5e-3)
        np.testing.assert_allclose(axis_of(fore, stamp)[-1], axis_of(hand, stamp)[0], atol=5e-3)
        hands.append(axis_of(hand, stamp)[-1])
    assert not hand.is_present(START_NS + int(1e9 * (visit.start_s - 0.1)))
    assert not hand.is_present(START_NS + int(1e9 * (visit.end_s + 0.1)))
    assert hands[0][0] > 1.1 and np.min(np.linalg.norm(np.array(hands)[:, :2] - visit.pile, axis=1)) < 0.07


@pytest.mark.parametrize("place", PLACES)
def test_no_visit_goes_through_the_table_or_what_stands_on_it(place: str) -> None:
    for seed in SEEDS:
        visit = visit_of(place, seed)
        parts, solid = human_arm(visit, START_NS), [*tabletop.furniture(), *things(place, seed)]
        for second in np.arange(visit.start_s + 0.01, visit.end_s, 0.15):
            stamp = START_NS + int(second * 1e9)
            for part in parts:
                allowed = -0.03 if part.name == "human.hand" else -0.01  # the hand takes the cubes
                assert np.min(distance_to(solid, axis_of(part, stamp), stamp)) - part.size[0] > allowed, part.name


def test_seeds_differ_in_side_time_place_and_speed() -> None:
    visits = [visit_of(place, seed) for place in PLACES for seed in range(8)]
    assert {visit.side for visit in visits} == {-1, 1}
    assert len({visit.start_s for visit in visits}) == len({tuple(visit.pile) for visit in visits}) == 16
    speed = [np.linalg.norm(v.wrist[1] - v.wrist[0]) / (v.arrival_s[1] - v.departure_s[0]) for v in visits]
    assert 0.3 <= min(speed) < max(speed) <= 0.6
    assert all(visit.end_s < shared_workspace.DURATION_S for visit in visits)
    np.testing.assert_array_equal(visit_of("near-goal", 3).wrist, visit_of("near-goal", 3).wrist)


@pytest.mark.parametrize("place", PLACES)
def test_the_logged_arm_rests_while_the_person_is_there_and_does_its_task(place: str, arm: RobotModel) -> None:
    for seed in SEEDS:
        visit = visit_of(place, seed)
        motion = task_motion(visit)
        inside = np.linspace(visit.start_s, visit.end_s, 50)
        assert all(np.all(motion.at(float(second))[1] == 0.0) for second in inside)
        assert motion.times[-1] < shared_workspace.DURATION_S
    recording = Recording(RecordingOptions(seed=2, duration_s=24.0), arm, shared_workspace.scene_of(place, 2))
    assert recording.clearances()[1].min() > 0.02


def test_the_masks_show_the_moving_arm_where_the_truth_has_it(arm: RobotModel) -> None:
    options = RecordingOptions(seed=2, noise="none", width=80, height=60, fps=2.0)
    recording = Recording(options, arm, shared_workspace.scene_of("near-goal", 2))
    people = [p for p in recording.primitives if p.name.startswith("human")]
    for index in (2, 14, 20):
        for frame in recording.frames_at(index, np.array(shared_workspace.PICKUP)):
            assert frame.human is not None
            points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))
            distance = distance_to(people, points.reshape(-1, 3), frame.stamp_ns).reshape(frame.human.shape)
            assert ((np.abs(distance) < 1e-5) >= (frame.human > 0)).all()
            assert (frame.human > 0).any() == (index > 2) or frame.camera == "cam3"


def test_it_is_recorded_with_masks_and_the_moving_arm_in_the_truth(tmp_path: Path) -> None:
    out, size = tmp_path / "shared", ["--width", "32", "--height", "24"]
    assert main(["record", "near-pickup", *size, "--duration", "3", "-o", str(out)]) == 0
    hand = next(p for p in load_truth(out / "truth.json").primitives if p.name == "human.hand")
    assert hand.kind == "capsule" and hand.track is not None
    first, later = (hand.at(int(hand.track.stamp_ns[0]) + dt).T_world_shape for dt in (0, 1_000_000_000))
    assert np.linalg.norm(first[:3, 3] - later[:3, 3]) > 0.1
    with AnyReader([out / "log.mcap"]) as reader:
        assert "/cam0/people/mask" in {connection.topic for connection in reader.connections}
