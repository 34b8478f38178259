"""Bodies of the hunt: what is seen of the arm counts in the truth, and depth errs as stated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.urdf import read_urdf, visual_urdf
from splatctrl_cli.simulate.arm import UNMODELLED, Block, Capsule, link_shape
from splatctrl_cli.simulate.primitives import Primitive, signed_distance
from splatctrl_cli.simulate.render import StereoDepth
from splatctrl_cli.simulate.tabletop import arm_solids
from tests.tools.test_hunt import START, ball_at_link, clearance_at_start, in_view, read, shown_of, world_of
from tools.hunt.body import Body, draw_body
from tools.hunt.clearance import TrueArm
from tools.hunt.faults import Fault
from tools.hunt.trial import draw, record
from tools.hunt.world import at_s, draw_cameras

EXACT = StereoDepth(spread=0.0, fattening=(0.0, 0.0), dropout=0.0, width=640)


@pytest.fixture(autouse=True)
def few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Record two frames a camera, an eighth of a run."""
    monkeypatch.setattr("tools.hunt.recording.NUM_FRAMES", 2)


@pytest.mark.parametrize(("body", "clearance"), [(Body(), 0.004), (Body(is_slim=True), 0.007)])
def test_the_clearance_is_that_of_what_is_seen_of_the_arm(model: RobotModel, body: Body, clearance: float) -> None:
    target = ball_at_link(model, "hand", 0.025 + 0.05 + 0.004, 0.0, 0.033)  # 4 mm off the palm
    assert abs(clearance_at_start(TrueArm(model, body=body), target) - clearance) < 1e-6


@pytest.mark.parametrize("name", UNMODELLED)
def test_an_unmodelled_part_counts(model: RobotModel, name: str) -> None:
    link, capsules = UNMODELLED[name]
    arms = (TrueArm(model, body=Body(is_slim=True, parts=parts)) for parts in ((name,), ()))
    found, without = (
        clearance_at_start(arm, ball_at_link(model, link, *capsules[0].end, radius=0.001)) for arm in arms
    )
    assert found == pytest.approx(-0.001 - capsules[0].radius, abs=1e-6) and without > 0


def test_runs_of_seeds_below_two_hundred_keep_the_arm_and_the_depth_of_before() -> None:
    assert all(draw_body(seed, index, "thin") == Body() for seed in (0, 131, 199) for index in range(20))


def test_one_run_in_ten_of_later_seeds_is_as_before_and_the_others_are_not() -> None:
    bodies = [draw_body(seed, index, "thin") for seed in (200, 211) for index in range(500)]
    others = [body for body in bodies if body.depth is not None]
    assert 1 - len(others) / len(bodies) == pytest.approx(0.1, abs=0.03)
    assert all(body.is_slim for body in others)
    assert np.mean([bool(body.parts) for body in others]) == pytest.approx(0.2, abs=0.04)
    assert {body.parts for body in others} == {(), *((name,) for name in UNMODELLED)}
    spreads = [body.depth.spread for body in others if body.depth is not None]
    widths = [body.depth.fattening[1] for body in others if body.depth is not None]
    assert 0.005 <= min(spreads) < 0.01 and 0.075 < max(spreads) <= 0.08
    assert min(widths) < 0.1 and 2.9 < max(widths) <= 3.0


def test_benign_runs_have_no_unmodelled_part_and_a_camera_on_the_hand_no_bracket_before_it() -> None:
    assert not any(draw_body(211, index, "benign").parts for index in range(200))
    assert {draw_body(211, index, "wrist").parts for index in range(300)} == {(), ("tool",), ("cable",)}


@pytest.mark.parametrize("parts", [(), ("cable",), ("bracket",)])
def test_images_show_the_visual_shapes_and_the_unmodelled_parts(
    model: RobotModel, tmp_path: Path, parts: tuple[str, ...]
) -> None:
    body = Body(is_slim=True, parts=parts, depth=EXACT)
    cameras = draw_cameras(np.random.default_rng(0), body.width)
    world = replace(world_of(in_view()), body=body, cameras=cameras)
    shown_of(world, Fault(), model, tmp_path)
    on_part = 0
    for frame in (f for f in read(tmp_path)[1] if f.stamp_ns == at_s(0)):
        assert frame.depth.shape == (96, 128)
        points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))[frame.depth > 0]
        to_scene = np.min([np.abs(signed_distance(p, points)) for p in world.primitives], axis=0)
        to_body, to_parts = (
            np.min([np.abs(signed_distance(p, points)) for p in solids_of(model, some)], axis=0, initial=1.0)
            for some in (body.solids, body.solids[len(Body(is_slim=True).solids) :])
        )
        assert np.minimum(to_scene, to_body).max() < 4e-3  # steps of disparity, and a millimetre of the log
        on_part += int(np.sum((to_parts < 4e-3) & (to_scene > 0.01)))
    assert (on_part > 10) == bool(parts)


def solids_of(model: RobotModel, solids: list[tuple[str, Capsule | Block]]) -> list[Primitive]:
    shapes = [link_shape(link, shape) for link, shape in solids]
    return arm_solids(shapes, {shape.link: model.frame_pose(START, shape.link) for shape in shapes})


def test_a_run_with_visual_shapes_gives_the_tool_the_collision_shapes_of_before(
    model: RobotModel, tmp_path: Path
) -> None:
    trial = next(t for t in (draw(211, index, model) for index in range(10)) if t.world.body.is_slim)
    record(trial, model, tmp_path)
    urdf = read_urdf(tmp_path / "robot.urdf")
    assert [(s.link, s.size) for s in urdf.shapes] == [(s.link, s.size) for s in model.urdf.shapes]
    assert len(visual_urdf(urdf).shapes) > len(urdf.shapes)
    assert {c.intrinsics.width for c in trial.world.cameras} == {128}


def test_depth_of_a_later_seed_errs_as_its_imagers_do_whatever_the_width_of_the_image(
    model: RobotModel, tmp_path: Path
) -> None:
    world, errors = world_of(in_view()), []
    for depth in (EXACT, StereoDepth(spread=0.07, fattening=(0.0, 0.0), dropout=0.0, width=640)):
        shown_of(replace(world, body=Body(is_slim=True, depth=depth)), Fault(), model, tmp_path)
        errors.append(np.array([frame.depth for frame in read(tmp_path)[1]]))
    is_there = (errors[0] > 0) & (errors[1] > 0)
    share = (errors[1] - errors[0])[is_there] / errors[0][is_there] ** 2
    assert np.std(share) == pytest.approx(0.0036, rel=0.1)
