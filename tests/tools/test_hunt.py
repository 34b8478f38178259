"""The hunt's generator, its truth and its rules."""

from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import Config
from splatctrl_cli.evaluate.verdict import Outcome, Reason, verdict_of
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.jobs.replay.state_pass import NEAR_COLUMNS
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import JointState, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import Capsule, Motion
from splatctrl_cli.simulate.primitives import Primitive, Texture, signed_distance
from tools.hunt.body import Body
from tools.hunt.clearance import TrueArm, interpolated, least_clearance
from tools.hunt.families import CAMERAS, FAMILIES, Draft
from tools.hunt.faults import Fault
from tools.hunt.observability import observable
from tools.hunt.outcome import word_of
from tools.hunt.recording import Recorder, Shown
from tools.hunt.trial import BEFORE_CAMERAS, Trial, box_of, config_of, draw, family_of, record
from tools.hunt.world import (
    BOX,
    DURATION_S,
    NUM_FRAMES,
    World,
    at_s,
    draw_cameras,
    during,
    moving,
    positions_of,
    table,
    wrist_camera,
)

START = np.array([-0.1, 0.1, 0.0, -1.9, 0.0, 2.1, 0.4])
AT_REST = interpolated(np.array([at_s(0), at_s(3)]), np.array([START, START]))
GREY = Texture(pattern="checks", feature=0.05, dark=(0.1, 0.1, 0.1), bright=(0.9, 0.9, 0.9))


def ball(place: np.ndarray, radius: float = 0.05, name: str = "target") -> Primitive:
    return Primitive(name=name, kind="sphere", size=(radius,), T_world_shape=pose_at(place), texture=GREY)


def world_of(target: Primitive) -> World:
    motion = Motion(times=np.array([0.0, 0.6, 2.5]), waypoints=np.array([START, START, START + 0.2]))
    return World(motion=motion, things=(table(),), targets=(target,), cameras=draw_cameras(np.random.default_rng(0)))


def in_view() -> Primitive:
    return ball(np.array([0.55, 0.1, 0.05]))


def shown_of(world: World, fault: Fault, model: RobotModel, folder: Path) -> Shown:
    return Recorder(world, fault, model, (0, 0)).write(folder / "log.mcap")


def ball_at_link(model: RobotModel, link: str, *offset: float, radius: float = 0.05) -> Primitive:
    """A ball at an offset [m] in the frame of a link."""
    return ball((model.frame_pose(START, link) @ [*offset, 1.0])[:3], radius)


def clearance_at_start(arm: TrueArm, target: Primitive) -> float:
    return float(arm.clearances([target], np.array([at_s(0)]), START[None])[0])


def least_at_rest(model: RobotModel, target: Primitive) -> tuple[float, float]:
    """The least clearance of an arm that stays in START for three seconds, and its stamp."""
    return least_clearance(TrueArm(model), [target], AT_REST, at_s(0), at_s(3))


Recorded = Callable[[Fault], tuple[Shown, Path]]


@pytest.fixture(scope="module")
def recorded(model: RobotModel, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Record a fault once; return what its images show of the target, and the log's folder."""
    found: dict[str, tuple[Shown, Path]] = {}

    def record_once(fault: Fault) -> tuple[Shown, Path]:
        if str(fault) not in found:
            folder = tmp_path_factory.mktemp("recorded")
            found[str(fault)] = shown_of(world_of(in_view()), fault, model, folder), folder
        return found[str(fault)]

    return record_once


def read(folder: Path) -> tuple[list[JointState], list[RgbdFrame]]:
    records = list(open_source(folder / "log.mcap").records())
    return (
        [record for record in records if isinstance(record, JointState)],
        [record for record in records if isinstance(record, RgbdFrame)],
    )


# --- the truth ---


@pytest.mark.parametrize(
    ("link", "offset", "clearance"),
    [
        *(("hand", (0.025 + 0.05 + gap, 0.0, 0.033), gap) for gap in (0.04, 0.003, -0.01)),  # beside its palm
        ("link5", (-0.052 - 0.05 - 0.02, 0.0, -0.25), 0.02),  # a capsule of 52 mm from z = -0.25 to -0.19
    ],
)
def test_the_clearance_of_a_ball_beside_a_link_is_exact(
    model: RobotModel, link: str, offset: tuple[float, ...], clearance: float
) -> None:
    assert abs(clearance_at_start(TrueArm(model), ball_at_link(model, link, *offset)) - clearance) < 1e-6


@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule", "sphere"])
def test_the_clearance_is_no_more_than_that_of_any_point_of_the_surface(model: RobotModel, kind: str) -> None:
    rng = np.random.default_rng(5)
    size = {"box": (0.1, 0.2, 0.06), "cylinder": (0.05, 0.2), "capsule": (0.03, 0.2), "sphere": (0.06,)}[kind]
    arm, hand = TrueArm(model), model.frame_pose(START, "hand")
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 41)] * 3), -1).reshape(-1, 3)
    points = grid * [0.05, 0.18, 0.066] + [0, 0, 0.033]
    world_points = points @ hand[:3, :3].T + hand[:3, 3]
    for _ in range(6):
        T = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        pose = pose_at(
            hand[:3, 3] + hand[:3, :3] @ [*rng.uniform(0.05, 0.2, 1), *rng.uniform(-0.2, 0.2, 1), 0.033],
            T * np.sign(np.linalg.det(T)),
        )
        solid = replace(ball(np.zeros(3)), kind=kind, size=size, T_world_shape=pose)
        found = clearance_at_start(arm, solid)
        sampled = float(signed_distance(solid, world_points).min())
        assert found < 0 if sampled < 0 else found <= sampled + 1e-4


def test_the_least_clearance_is_found_between_two_samples(model: RobotModel) -> None:
    near = ball_at_link(model, "hand", 0.025 + 0.05 + 0.004, 0.0, 0.033)  # 4 mm beside the palm, for a moment
    away = 0.4 * model.frame_pose(START, "hand")[:3, 0]
    found, when = least_at_rest(model, moving(near, [0.6, 1.0073, 1.4], np.array([away, 0 * away, away])))  # at 1 m/s
    assert (found, when) == (pytest.approx(0.004, abs=3e-4), pytest.approx(at_s(1.0073), abs=1e6))


def test_a_ball_that_passes_a_round_link_is_nearest_between_two_samples(model: RobotModel) -> None:
    side = 0.29 * model.frame_pose(START, "link6")[:3, 2]
    passing = ball_at_link(
        model, "link6", 0.044, -0.048 - 0.01 - 0.004, 0.0, radius=0.01
    )  # a capsule of 48 mm along x
    target = moving(passing, [1.0, 1.58], np.array([-side, side]))  # nearest at 1.29 s
    found, when = least_at_rest(model, target)
    fine = np.arange(at_s(1.28), at_s(1.30), 100_000)
    assert abs(found - TrueArm(model).clearances([target], fine, AT_REST(fine)).min()) < 2e-4
    assert abs(when - at_s(1.29)) < 5e6


def test_what_is_there_for_a_millisecond_alone_counts(model: RobotModel) -> None:
    assert least_at_rest(model, during(ball_at_link(model, "hand", 0.0, 0.0, 0.0), 1.0007, 1.0017))[0] < 0


def test_a_tool_that_no_model_has_counts(model: RobotModel) -> None:
    tool = Capsule(start=(0.0, 0.0, 0.08), end=(0.0, 0.0, 0.2), radius=0.02)
    target = ball_at_link(model, "hand", 0.0, 0.0, 0.2 + 0.02 + 0.05 + 0.01)
    assert abs(clearance_at_start(TrueArm(model, tool), target) - 0.01) < 1e-6
    assert clearance_at_start(TrueArm(model), target) > 0.05


# --- the faults are in the data ---


def test_a_scale_and_a_bias_are_in_the_depth_of_their_camera_alone(recorded: Recorded) -> None:
    exact = {(f.camera, f.stamp_ns): f.depth for f in read(recorded(Fault())[1])[1]}
    for frame in read(recorded(Fault(depth_scale={"cam0": 1.05}, depth_bias={"cam0": -0.02}))[1])[1]:
        before = exact[frame.camera, frame.stamp_ns]
        expected = np.where(before > 0, before * 1.05 - 0.02, 0) if frame.camera == "cam0" else before
        assert np.abs(frame.depth - expected).max() < 2e-3


def test_a_pose_error_is_in_the_recorded_pose_and_not_in_the_image(recorded: Recorded) -> None:
    error = np.array([0.03, 0.0, -0.04, 0.0, 0.02, 0.0])
    _, folder = recorded(Fault(pose={"cam1": error}))
    frame = next(f for f in read(folder)[1] if f.camera == "cam1")
    true = world_of(in_view()).cameras[1].T_world_camera
    assert np.allclose(frame.T_world_camera[:3, 3] - true[:3, 3], error[:3], atol=1e-6)
    assert np.isclose(np.arccos((np.trace(frame.T_world_camera[:3, :3].T @ true[:3, :3]) - 1) / 2), 0.02, atol=1e-4)


def test_late_stamps_are_late_and_lost_frames_lost(recorded: Recorded) -> None:
    fault = Fault(
        clock={"cam2": 0.3}, lost=frozenset({("cam0", 4)}), blind=frozenset({("cam1", 5)}), lost_states=(1.0, 1.5)
    )
    shown, folder = recorded(fault)
    states, frames = read(folder)
    assert min(f.stamp_ns for f in frames if f.camera == "cam2") == at_s(0.3)
    assert ("cam0", at_s(0.8)) not in {(f.camera, f.stamp_ns) for f in frames}
    assert shown.depth[0, 4] == 0
    assert all(not f.depth.any() for f in frames if (f.camera, f.stamp_ns) == ("cam1", at_s(1.0)))
    assert max(np.diff([state.stamp_ns for state in states])) > 0.45e9


def test_a_dark_target_returns_no_depth_and_keeps_its_outline(recorded: Recorded) -> None:
    shown, _ = recorded(DARK)
    assert shown.target.sum() == 0
    assert shown.target_outline.sum() > 50
    assert recorded(Fault())[0].target.sum() > 50


@pytest.mark.parametrize(
    "fault",
    [
        Fault(order=(2, 0, 1, 3, 4, 5, 6)),
        Fault(offset=(0.1, 0, 0, 0, 0, -0.2, 0)),
        Fault(in_degrees=True, order=(1, 0, 2, 3, 4, 5, 6)),
    ],
)
def test_logged_joints_and_commands_are_each_others_inverse(fault: Fault) -> None:
    q = np.random.default_rng(0).standard_normal((5, 7))
    assert not np.allclose(fault.logged(q), q)
    assert np.allclose(fault.true_of(fault.logged(q)), q)


def test_a_longer_link_is_longer_by_that_much(model: RobotModel, tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(Fault(longer=(2, 0.05)).urdf())
    wrong = RobotModel.from_urdf(tmp_path / "robot.urdf", Fault().spheres(np.random.default_rng(0)))
    before, after = (robot.frame_pose(np.zeros(7), "link3")[:3, 3] for robot in (model, wrong))
    assert np.isclose(np.linalg.norm(after - before), 0.05)


@pytest.mark.parametrize("family", list(FAMILIES))
def test_each_family_spoils_or_places_something(family: str) -> None:
    for seed in range(20):
        draft = FAMILIES[family](np.random.default_rng(seed))
        changes = draft.fault, draft.tool, draft.cameras, draft.distance, draft.box_gap, bool(draft.settings)
        assert (changes == (Fault(), None, CAMERAS, 1, None, False)) == (
            family in ("benign", "thin", "touch", "visit", "people", "still")
        )


def drawn(model: RobotModel, family: str, seed: int = 500) -> Trial:
    return draw(seed, next(i for i in range(60) if family_of(seed, i) == family), model)


@pytest.mark.parametrize("repeats_color", [True, False])
def test_repeated_frames_have_new_stamps_and_the_depth_of_the_last_one(
    repeats_color: bool, model: RobotModel, tmp_path: Path
) -> None:
    shown = shown_of(world_of(in_view()), Fault(repeated=6, repeats_color=repeats_color), model, tmp_path)
    mine = [frame for frame in read(tmp_path)[1] if frame.camera == "cam0"]
    assert len({frame.stamp_ns for frame in mine}) == NUM_FRAMES
    assert all((frame.depth == mine[5].depth).all() for frame in mine[6:])
    assert all((frame.color == mine[5].color).all() == repeats_color for frame in mine[9:])
    assert shown.target[:, :6].any()
    assert not shown.target[:, 6:].any()
    assert not shown.depth[:, 6:].any()


@pytest.mark.parametrize("fault", [Fault(beyond=0.4), Fault(instead=4.0)])
def test_a_target_measured_behind_its_place_is_seen_where_its_rays_meet_the_table(
    fault: Fault, model: RobotModel, tmp_path: Path
) -> None:
    shown = shown_of(world_of(in_view()), fault, model, tmp_path)
    assert shown.target.any()
    assert (shown.target <= shown.target_outline).all()
    (frame, *_) = read(tmp_path)[1]
    assert fault.instead is None or np.isclose(frame.depth.max(), 4.0, atol=1e-3)
    high = world_of(ball(np.array([0.55, 0.1, 0.6])))
    (tmp_path / "high").mkdir()
    assert not shown_of(high, Fault(beyond=0.15), model, tmp_path / "high").target.any()  # in free space above it


def test_a_small_motion_is_small_and_its_ball_behind_the_arm(model: RobotModel) -> None:
    trial = drawn(model, "small")
    q = positions_of(trial.world.motion, np.array([at_s(0.0), at_s(DURATION_S)]))
    arm = TrueArm(model, None, trial.world.body)
    assert np.linalg.norm(np.diff(arm.marks(q), axis=0), axis=2).max() < 0.2
    place, marks = trial.world.targets[0].T_world_shape[:3, 3], arm.marks(q).reshape(-1, 3)
    eyes = np.mean([camera.T_world_camera[:3, 3] for camera in trial.world.cameras], axis=0)
    assert np.linalg.norm(marks - place, axis=1).min() < 0.25
    away = place - marks
    assert (away @ (BEFORE_CAMERAS - eyes) > 0.5 * np.linalg.norm(away, axis=1)).any()


def test_a_box_ends_before_the_plate(model: RobotModel) -> None:
    trial = drawn(model, "box")
    (plate,) = trial.world.targets
    assert box_of(trial).upper[0] == pytest.approx(
        plate.T_world_shape[0, 3] - plate.size[0] / 2 - trial.draft.box_gap
    )
    assert box_of(drawn(model, "still")) is BOX


@pytest.mark.parametrize(
    ("outcome", "how", "word"),
    [
        *((Outcome.PASSED, how, word) for how, word in (("", "safe"), ("proven", "safe"), ("waived", "waived"))),
        *((Outcome.FAILED, how, "failed") for how in ("", "proven", "waived")),
    ],
)
def test_what_passed_by_a_waiver_is_no_safe_run(outcome: Outcome, how: str, word: str) -> None:
    verdict = verdict_of("replay", [Reason(outcome=outcome, sentence="")], how=how)
    assert word_of(verdict, known_near(), 0.02).word == word


def known_near(**changes: float) -> Any:
    """The account of one state about which all was seen free, with `changes` to its columns."""
    near = {name: np.zeros((1, *shape)) for name, shape in NEAR_COLUMNS.items()}
    near["class_distance"] += np.inf
    far = {name: np.array([np.inf]) for name in near if name in ("unseen_path", "blind_to_surface")}
    return near | far | {name: np.array([value]) for name, value in changes.items()}


@pytest.mark.parametrize(
    ("num_lacking", "changes", "only"),
    [
        (1, {"unseen": 0.9}, "unseen"),
        (2, {"unseen": 0.9}, ""),
        (2, {"unseen": 0.9, "unseen_path": 0.01}, ""),
        (1, {}, ""),
    ],
)
def test_a_run_names_the_one_limit_without_which_it_is_safe(
    num_lacking: int, changes: dict[str, float], only: str
) -> None:
    verdict = verdict_of("replay", [Reason(outcome=Outcome.NOT_EVALUABLE, sentence="")] * num_lacking)
    assert word_of(verdict, known_near(**changes), 0.02).only == only


@pytest.mark.parametrize(
    ("seed", "families"),
    [
        (99, {13: "people", 14: "benign", 15: "benign"}),
        (100, {13: "people", 14: "behind", 18: "benign", 19: "benign"}),
        (499, {17: "settings", 18: "benign", 19: "benign"}),
        (500, {17: "settings", 18: "frozen", 24: "still", 25: "benign", 26: "benign"}),
    ],
)
def test_seeds_below_a_hundred_keep_their_families(seed: int, families: dict[int, str]) -> None:
    """Rows of campaigns are drawn again by seed and index."""
    assert {index: family_of(seed, index) for index in families} == families


def test_settings_that_a_run_draws_are_those_of_its_configuration(model: RobotModel) -> None:
    trial = drawn(model, "settings", 100)
    assert trial.draft.settings
    for key, value in trial.draft.settings:
        chosen, default = attrgetter(key)(config_of(trial)), attrgetter(key)(Config())
        assert chosen == pytest.approx(value, abs=0.5) and chosen != default


def test_a_camera_on_the_hand_rides_with_it_and_sees_nothing_nearer_than_it_can(
    model: RobotModel, tmp_path: Path
) -> None:
    trial = drawn(model, "wrist", 100)
    record(trial, model, tmp_path)
    frames = [frame for frame in read(tmp_path)[1] if frame.camera == "wrist"]
    assert len(frames) == NUM_FRAMES
    for frame in frames:
        hand = model.frame_pose(trial.world.positions(np.array([frame.stamp_ns]))[0], "hand")
        assert np.allclose(frame.T_world_camera, hand @ wrist_camera().T_world_camera, atol=1e-6)
        assert frame.depth[frame.depth > 0].min() >= 0.2


# --- the same seed, the same run ---


def test_the_same_seed_records_the_same_bytes(
    model: RobotModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where two imagers give depth."""
    monkeypatch.setattr("tools.hunt.recording.NUM_FRAMES", 4)
    contents = []
    assert draw(211, 1, model).world.body.depth is not None
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        record(draw(211, 1, model), model, tmp_path / name)
        contents.append([(tmp_path / name / file).read_bytes() for file in ("log.mcap", "robot.urdf", "robot.yaml")])
    assert contents[0] == contents[1]


def test_drawn_targets_are_in_contact_or_clear_as_wished(model: RobotModel) -> None:
    trials: list[Trial] = [draw(11, index, model) for index in range(1, 5)]
    stamps = np.linspace(at_s(0), at_s(DURATION_S), 60).astype(np.int64)
    clearance = [
        TrueArm(model, t.world.tool).clearances(t.world.targets, stamps, positions_of(t.world.motion, stamps)).min()
        for t in trials
    ]
    assert 0.2 < np.mean(np.array(clearance) < 0) < 1.0
    assert max(clearance) > 0.0


# --- what is observable ---


def judged(draft: Draft, world: World, shown: Shown, model: RobotModel, *, is_audit: bool = True) -> tuple[bool, str]:
    stamps = shown.stamps.astype(np.int64)
    clearance = TrueArm(model).clearances(world.targets, stamps, world.positions(stamps))
    found = observable(draft, world, shown, frame_clearance=clearance, least_ns=at_s(2.4), is_audit=is_audit)
    return found.holds, found.rule


def draft_of(fault: Fault, cameras: tuple[str, ...] = CAMERAS) -> Draft:
    return Draft(kind="", strength=0.0, make=lambda place: (ball(place),), fault=fault, cameras=cameras)


BIASED, LATE, DARK = Fault(depth_bias={"cam0": 0.03}), Fault(clock=dict.fromkeys(CAMERAS, 0.2)), Fault(dark=1.0)
WHILE_MOVING = slice(3, 13)  # frames: it moves from 0.6 to 2.5 s
Edit = Callable[[Shown], Shown]


def emptied(*names: str, frames: slice = slice(None), value: int = 0) -> Edit:
    """Other counts of what images show."""

    def edit(shown: Shown) -> Shown:
        parts = {name: getattr(shown, name).copy() for name in names}
        for part in parts.values():
            part[:, frames] = value
        return replace(shown, **parts)

    return edit


@pytest.mark.parametrize(
    ("fault", "world", "edits"),
    [
        (
            BIASED,
            {"num_cameras": 1},
            [(emptied(), (True, "")), (emptied("arm"), (False, "a camera alone that never sees the arm"))],
        ),
        (BIASED, {}, [(emptied("arm"), (True, "")), (emptied("arm", "overlap"), (False, ""))]),
        (
            LATE,
            {},
            [
                (emptied(), (True, "")),
                (emptied("arm", frames=WHILE_MOVING), (False, "no image of the arm while it moves")),
            ],
        ),
        (
            Fault(),
            {"body": Body(parts=("bracket",))},
            [(emptied(), (True, "")), (emptied("arm"), (False, "no image of the arm"))],
        ),
        (DARK, {"radius": 0.01}, [(emptied("target_outline", "target_hole"), (False, "no depth from it"))]),
        (
            DARK,
            {},
            [
                (emptied("target_outline", "target_hole"), (True, "space never seen")),
                (emptied(), (True, "a hole")),
                (emptied("target_hole"), (True, "dark, in space never seen")),
            ],
        ),
        (Fault(), {"radius": 0.002}, [(emptied("target", value=10), (False, ""))]),
        (Fault(), {"radius": 0.006}, [(emptied("target", value=10), (True, ""))]),
    ],
)
def test_a_fault_or_target_is_observable_where_images_show_it(
    model: RobotModel,
    recorded: Recorded,
    tmp_path: Path,
    fault: Fault,
    world: dict[str, Any],
    edits: list[tuple[Edit, tuple[bool, str]]],
) -> None:
    """A target narrower than half a pixel is disclaimed; where no rule is given, it is not judged.

    The draft of a dark target names no fault.
    """
    made = world_of(ball(np.array([0.55, 0.1, 0.05]), world.get("radius", 0.05)))
    made = replace(made, cameras=made.cameras[: world.get("num_cameras", 3)], body=world.get("body", Body()))
    shown = shown_of(made, fault, model, tmp_path) if world else recorded(fault)[0]
    for edit, expected in edits:
        holds, rule = judged(draft_of(Fault() if fault == DARK else fault), made, edit(shown), model)
        assert (holds, rule if expected[1] else "") == expected


def test_a_target_between_two_frame_sets_is_not_observable(model: RobotModel, tmp_path: Path) -> None:
    brief = world_of(during(ball(model.frame_pose(START + 0.2, "hand")[:3, 3]), 2.65, 2.75))
    shown = shown_of(brief, Fault(), model, tmp_path)
    assert judged(draft_of(Fault()), brief, shown, model) == (False, "between two frame sets")


def test_what_moves_is_disclaimed_in_closed_loop_alone(model: RobotModel, tmp_path: Path) -> None:
    hand = model.frame_pose(START, "hand")[:3, 3] + [0.09, 0.0, 0.0]
    world = world_of(moving(ball(hand), [0.2, 1.0], np.array([[0.4, 0.0, 0.1], [0.0, 0.0, 0.0]])))
    shown = shown_of(world, Fault(), model, tmp_path)
    assert judged(draft_of(Fault()), world, shown, model) == (True, "seen inside the margin")
    driven = judged(draft_of(Fault()), world, shown, model, is_audit=False)
    assert driven == (False, "moves between two frame sets")


def test_a_dark_target_measured_in_free_space_is_disclaimed(model: RobotModel, recorded: Recorded) -> None:
    beside = emptied("target_hole")(recorded(DARK)[0])
    assert judged(draft_of(Fault(beyond=0.3)), world_of(in_view()), beside, model) == (
        False,
        "measured in free space",
    )
