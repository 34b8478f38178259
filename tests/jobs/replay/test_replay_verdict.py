"""Every criterion of a replay's verdict turns it when it alone is broken."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.checks.clock_offset import ClockOffset
from splatctrl_cli.cli.main import main
from splatctrl_cli.config.fixed import UNSEEN
from splatctrl_cli.jobs.replay import replay as job
from splatctrl_cli.jobs.replay.replay import CRITERIA, REQUESTED
from tests.cli.replay_desk import SECOND, START, grid_seen
from tests.jobs.replay.broken import (
    ALONE,
    ELSEWHERE,
    beside_the_mount,
    displaced_camera,
    dropped_states,
    gap_in_the_log,
    in_contact,
    late_maps,
    near_margin,
    no_new_map,
)
from tests.jobs.stage import (
    FAR,
    MOVE,
    QUARTER,
    Stage,
    ball_beside,
    decisive,
    passing,
    resting,
    states_on,
    unseen_about,
    voxels,
)


@pytest.mark.parametrize("mode", ["audit", "open-loop", "closed-loop"])
def test_a_run_with_nothing_broken_is_safe(stage: Stage, mode: str) -> None:
    code, verdict = stage.judged(mode=mode)
    assert (code, verdict["outcome"], verdict["label"], decisive(verdict)) == (0, "passed", "safe", {})
    assert all(reason["count"] for reason in verdict["reasons"])
    assert {"clearance", "self-clearance", "position limits", "velocity limits", "surface clearance"} <= {
        reason["criterion"] for reason in verdict["reasons"]
    }
    assert "map error not measured" in verdict["sentence"]


def test_what_asks_for_less_than_the_defaults_stands_in_the_sentence(stage: Stage) -> None:
    laxer = ("--max-map-age=100", "--max-unknown=0.5", "--set=verdict.lead_in=2", "--set=control.margin=0.01")
    code, verdict = stage.judged(*laxer, "--set=verdict.confidence=0.999")
    assert code == 0 and [note for note in verdict["notes"] if note.startswith("waived: ")] == [
        "waived: --max-unknown 0.5 (by default 0.05)",
        "waived: --max-map-age 100 (by default 1)",
        "waived: verdict.lead_in 2 (by default 0.5)",
        "waived: control.margin 0.01 (by default 0.02)",
    ]
    assert verdict["sentence"].count("waived: ") == 4


def test_every_criterion_is_shown_to_turn_the_verdict() -> None:
    names = [criterion.name for criterion in CRITERIA]
    assert len(set(names)) == len(names) and set(names) == ELSEWHERE | {of for _, _, of, _, _ in ALONE.values()} - {
        "judged states"
    }
    assert all(criterion.docs.count(" | ") == 2 for criterion in CRITERIA)


CODES = {"not evaluable": 5}


@pytest.mark.parametrize("name", ALONE)
def test_one_criterion_that_is_broken_turns_the_verdict_and_names_itself(stage: Stage, name: str) -> None:
    broken, arguments, criterion, label, words = ALONE[name]
    broken(stage)
    code, verdict = stage.judged(*arguments)
    assert set(decisive(verdict)) == {criterion} and (verdict["label"], code) == (label, CODES.get(label, 1))
    assert words in verdict["sentence"]
    assert not criterion.startswith(REQUESTED), "with --report-only it turns no exit code"


def test_a_broken_margin_says_when_where_and_who(stage: Stage) -> None:
    near_margin(stage)
    _, verdict = stage.judged()
    worst = verdict["reasons"][0]
    assert (worst["value"], worst["threshold"]) == (pytest.approx(0.01, abs=1e-5), 0.02)
    assert worst["who"].startswith("hand[") and worst["time_s"] == pytest.approx(1.0)
    center, radius = stage.balls[1]
    assert np.linalg.norm(np.array(worst["place"]) - center) == pytest.approx(radius, abs=1e-5)
    assert worst["count"] == 11
    assert stage.judged("--report-only", scene=stage.desk.folder / "scene")[0] == 0


def test_what_a_displaced_camera_shows_beside_the_arm_may_be_the_arm_itself_and_what_no_map_shows_is_not_doubted(
    stage: Stage,
) -> None:
    displaced_camera(stage)
    in_contact(stage)
    code, verdict = stage.judged()
    assert (code, verdict["label"]) == (5, "not evaluable")
    assert decisive(verdict) == {"calibration": "not evaluable", "clearance": "not evaluable"}
    assert "cam0 sees the robot 9.0 mm" in verdict["sentence"] and verdict["reasons"][0]["who"] == "cam0"
    truth = stage.truth(FAR, stage.ball_at_the_end(-0.01))
    code, verdict = stage.judged("--truth", str(truth), scene=stage.desk.folder / "scene")
    assert (code, verdict["label"], verdict["reasons"][0]["criterion"]) == (1, "contact", "true clearance")


def test_an_object_that_may_be_a_part_of_the_arm_does_not_fail_a_driven_motion(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_contact(stage)
    scene, brief = stage.scene(), ("--set", "control.max_time=0.5")
    assert stage.judged(*brief, scene=scene, mode="closed-loop")[0] == 1
    found = ("fore", "moves too little (3 of 5 configurations)")
    monkeypatch.setattr("splatctrl_cli.jobs.replay.replay.unlearned_link", lambda judged: found)
    assert stage.judged(*brief, scene=scene, mode="closed-loop")[0] == 5
    code, verdict = stage.judged(scene=scene)
    assert (code, verdict["label"]) == (1, "contact"), "of the logged motion only its own link's distance is in doubt"


def test_a_field_knows_that_a_camera_of_its_scene_was_displaced(stage: Stage) -> None:
    displaced_camera(stage)
    stage.balls = [FAR, ball_beside(stage.arm, START, -0.01)]
    field = stage.desk.folder / "field"
    assert main(["sdf-bake", str(stage.scene()), "-o", str(field), "-q"]) == 0
    code, verdict = stage.replayed("--field", str(field))
    assert (code, verdict["label"], verdict["reasons"][0]["criterion"]) == (5, "not evaluable", "calibration")
    assert decisive(verdict)["certified clearance"] == "not evaluable"


def test_a_users_controller_that_fails_is_not_doubted_for_a_displaced_camera(stage: Stage) -> None:
    displaced_camera(stage)
    dead = ("--controller-command", "sh -c 'read a; echo {\\\"protocol\\\":1}'")
    code, verdict = stage.judged(*dead, mode="closed-loop")
    assert (code, verdict["label"]) == (1, "controller failed") and decisive(verdict)["controller"] == "failed"


@pytest.mark.parametrize(("gap", "code"), [(0.0185, 1), (0.0195, 0)])
def test_the_margin_is_kept_up_to_what_a_solver_leaves(stage: Stage, gap: float, code: int) -> None:
    stage.states, stage.balls = resting(), [FAR, ball_beside(stage.arm, START, gap)]
    assert stage.judged()[0] == code


@pytest.mark.parametrize(("gap", "label"), [(0.01, "margin broken"), (-0.01, "contact")])
def test_the_truth_alone_turns_the_verdict(stage: Stage, gap: float, label: str) -> None:
    code, verdict = stage.judged("--truth", str(stage.truth(FAR, stage.ball_at_the_end(gap))))
    assert (code, verdict["label"], decisive(verdict)) == (1, label, {"true clearance": "failed"})
    assert verdict["reasons"][0]["value"] == pytest.approx(gap, abs=1e-5)
    assert "near ball1" in verdict["sentence"]


def test_contact_by_the_truth_is_contact_where_the_map_only_breaks_the_margin(stage: Stage) -> None:
    stage.balls = [FAR, stage.ball_at_the_end(0.01)]
    code, verdict = stage.judged("--truth", str(stage.truth(FAR, stage.ball_at_the_end(-0.01))))
    assert (code, verdict["label"]) == (1, "contact")
    assert verdict["sentence"].startswith("replay: CONTACT") and "true clearance: hand" in verdict["sentence"]


def test_what_stands_at_the_mount_from_the_start_is_only_said(stage: Stage) -> None:
    stage.balls = [FAR, beside_the_mount(stage.arm)]
    code, verdict = stage.judged()
    assert (code, decisive(verdict)) == (0, {})
    listed = stage.desk.json("events.json")["static_violations"]
    nearest = min(listed, key=lambda one: one["clearance"])
    assert nearest["clearance"] < 0 and nearest["sphere"].startswith("link0[")
    assert any(f"{len(listed)} fixed spheres stand within the margin" in note for note in verdict["notes"])


def test_what_comes_nearer_to_a_fixed_sphere_that_stood_free_counts(stage: Stage) -> None:
    stage.balls = [FAR, beside_the_mount(stage.arm, 0.042)]
    stage.later = [beside_the_mount(stage.arm, 0.0155)]  # by less than what a mount's map grows
    code, verdict = stage.judged()
    assert (code, verdict["label"], decisive(verdict)) == (1, "margin broken", {"static clearance": "failed"})


@pytest.mark.parametrize(("gap", "code"), [(-0.010, 0), (-0.016, 1)])
def test_at_a_mount_only_what_comes_much_nearer_counts(stage: Stage, gap: float, code: int) -> None:
    stage.balls = [FAR, beside_the_mount(stage.arm, 0.015)]
    stage.later = [beside_the_mount(stage.arm, gap)]
    found, verdict = stage.judged()
    assert (found, decisive(verdict)) == (code, {"static clearance": "failed"} if code else {})


def test_what_is_seen_at_a_mount_for_the_first_time_did_not_come(stage: Stage) -> None:
    """A camera on the hand sees the table about its base when it turns there."""
    stage.later = [beside_the_mount(stage.arm)]
    stage.last_seen = unseen_about(stage.later[0][0], 0.1)
    code, verdict = stage.judged()
    assert (code, decisive(verdict)) == (0, {})


def test_acceleration_limits_count_where_they_are_set(stage: Stage) -> None:
    seconds = np.arange(11)[:, None] * 0.05
    stage.states = states_on(START + 0.5 * 4.0 * seconds**2 * np.array([1.0, 0, 0, 0, 0, 0, 0]), step_ns=SECOND // 20)
    scene = stage.scene()
    code, verdict = stage.judged("--set", "control.max_acceleration=1", scene=scene)
    assert (code, decisive(verdict)) == (1, {"acceleration limits": "failed"})
    assert "joint1 reaches" in verdict["sentence"]
    assert stage.judged("--set", "control.max_acceleration=3", scene=scene)[0] == 0
    assert stage.judged(scene=scene)[0] == 0


@pytest.mark.parametrize("height", [0.35, 0.6])
def test_unknown_space_counts_from_the_share_that_is_allowed(stage: Stage, height: float) -> None:
    above = grid_seen().origin[2] + 0.1 * np.arange(40) > height
    stage.last_seen = voxels(is_known=~above)
    scene = stage.scene()
    stage.judged(scene=scene)
    share = stage.desk.metrics()["unknown_share"]
    assert (height < 0.5) == (share > 0.5) and 0.05 < share < 0.95
    for allowed, code in ((share - 1e-3, 5), (share + 1e-3, 0)):
        found, verdict = stage.judged("--max-unknown", str(allowed), scene=scene)
        assert found == code, verdict["sentence"]
        assert decisive(verdict) == ({"known space": "not evaluable"} if code else {})
        said = f"{100 * share:.1f} % of the sphere centres lie in unseen space, allowed {100 * allowed:g} %, first"
        assert any(said in reason["sentence"] for reason in verdict["reasons"]) == bool(code)


def test_at_most_half_of_the_space_beside_the_arm_may_be_unseen(stage: Stage) -> None:
    shares, codes, drawn = [], [], np.random.default_rng(0).random(grid_seen().log_odds.shape)
    for number, share in enumerate((0.3, 0.47, 0.6)):  # here and there, so that no link sees nothing
        stage.last_seen = voxels(is_seen=drawn > share)
        codes.append(stage.judged(scene=stage.scene(f"scene{number}"))[0])
        shares.append(stage.desk.metrics()["max_unseen_share"])
    assert [5 if share > UNSEEN else 0 for share in shares] == codes
    assert set(codes) == {0, 5} and min(abs(share - UNSEEN) for share in shares) < 0.15


def test_what_the_arm_has_about_it_is_said_of_a_safe_run(stage: Stage) -> None:
    """All of it seen free is proven, a part that was not is assumed, and waivers come before both."""
    hand = stage.arm.sphere_centers(stage.states[-1].position)[-1]
    for number, (reach, options, how, words) in enumerate(
        (
            (0.0, (), "proven", "SAFE, proven ("),
            (0.15, (), "", "of the space within the margin of the arm was assumed to be free"),
            (0.0, ("--max-map-age", "9"), "waived", "SAFE, waived ("),
        )
    ):
        stage.last_seen = unseen_about(hand, reach)
        code, verdict = stage.judged(*options, scene=stage.scene(f"scene{number}"))
        assert (code, verdict["how"]) == (0, how) and words in verdict["sentence"]
    stage.last_seen = unseen_about(hand, 0.15)
    for options, found in (
        (("--require-proof",), (5, {"known space": "not evaluable"})),
        (("--unseen", "occupied"), (1, {"known space": "failed"})),
    ):
        code, verdict = stage.judged(*options, scene=stage.scene("asked" + options[0]))
        assert (code, decisive(verdict)) == found
    assert verdict["label"] == "margin broken"


def test_what_was_known_about_the_arm_is_a_criterion_where_it_suffices_too(stage: Stage) -> None:
    stage.states = passing(np.array([1.8, 0, 0, 0, 0, 0, 0]))
    code, verdict = stage.judged()
    metrics, passed = stage.desk.metrics(), [r for r in verdict["reasons"] if r["outcome"] == "passed"]
    assert code == 0
    for criterion, figure, allowed in (
        ("known space", "max_unseen_share", UNSEEN),
        ("known space", "unknown_share", 0.05),
        ("evidence age", "max_evidence_age_s", 1.0),
    ):
        values = [(r["value"], r["threshold"]) for r in passed if r["criterion"] == criterion]
        assert (metrics[figure], allowed) in values


@pytest.mark.parametrize(
    ("broken", "allowed", "too_little"),
    [
        (no_new_map, "--max-map-age=1.76", "--max-map-age=1.74"),
        (gap_in_the_log, "--set=verdict.unjudged=0.51", "--set=verdict.unjudged=0.49"),
    ],
)
def test_a_map_may_be_as_old_and_as_much_time_unjudged_as_is_said(
    stage: Stage, broken: Callable[[Stage], None], allowed: str, too_little: str
) -> None:
    broken(stage)
    scene = stage.scene()
    assert (stage.judged(allowed, scene=scene)[0], stage.judged(too_little, scene=scene)[0]) == (0, 5)


def test_states_of_another_hour_are_not_judged_by_a_scene_or_a_field(stage: Stage) -> None:
    stage.states = states_on(np.tile(START, (11, 1)), start_ns=3600 * SECOND)
    code, verdict = stage.judged()
    assert code == 5 and {"map age", "evidence age", "evidence"} <= set(decisive(verdict))
    code, verdict = stage.judged_by_field(FAR, moment_ns=SECOND)
    assert (code, decisive(verdict)) == (5, {"map age": "not evaluable"})


def test_a_margin_that_only_the_grids_bound_breaks_is_a_matter_of_the_grid(stage: Stage) -> None:
    ball, moment = stage.ball_at_the_end(0.03), int(stage.states[-1].stamp_ns)
    code, verdict = stage.judged_by_field(FAR, ball, voxel=0.08, moment_ns=moment)
    assert (code, decisive(verdict)) == (5, {"certified clearance": "not evaluable"})
    found = re.search(r"bake again with --voxel at most ([\d.]+)", verdict["sentence"])
    assert 0.005 < float(found[1]) < 0.08


def test_a_field_that_does_not_say_of_what_time_it_is_is_no_evidence(stage: Stage) -> None:
    code, verdict = stage.judged_by_field(FAR)
    assert (code, decisive(verdict)) == (5, {"map age": "not evaluable"})
    assert "the baked field has no time" in verdict["sentence"]


def test_a_value_of_the_grid_below_the_margin_is_red(stage: Stage) -> None:
    code, verdict = stage.judged_by_field(FAR, stage.ball_at_the_end(-0.01))
    assert (code, verdict["label"], decisive(verdict)["clearance"]) == (1, "contact", "failed")
    assert decisive(verdict)["certified clearance"] == "failed"


def test_after_a_long_lead_in_the_rest_can_be_judged_as_the_remedy_says(stage: Stage) -> None:
    late_maps(stage)
    scene = stage.scene()
    code, verdict = stage.judged(scene=scene)
    assert code == 5 and "judge the rest alone with --start-time first-map" in verdict["sentence"]
    assert stage.desk.metrics()["unjudged_s"] == pytest.approx(0.6)
    code, verdict = stage.judged("--start-time", "first-map", scene=scene)
    assert (code, decisive(verdict)) == (0, {}) and "from 0.60 to 1.00 s of the log" in verdict["scope"]


def test_a_short_lead_in_is_left_out_and_said(stage: Stage) -> None:
    stage.map_stamps = [SECOND // 2, SECOND]
    code, verdict = stage.judged()
    assert code == 0 and "0.50 s before the first map are left out" in verdict["notes"]


def test_a_gap_that_the_arm_cannot_use_is_bounded(stage: Stage) -> None:
    stage.states = [s for i, s in enumerate(resting()) if i not in (4, 5, 6)]  # 0.4 s
    stage.balls = [((-4.0, 0.0, 1.3), 0.05)]
    assert stage.judged()[0] == 0


def test_a_controller_that_cannot_keep_its_rows_fails_alone(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatctrl_cli.jobs.replay.inputs.kept_margins", lambda *_: ())  # no pair keeps less
    goal = "--goal-joints=" + ",".join(str(v) for v in START)
    code, verdict = stage.judged("--set", "control.self_margin=0.06", goal, mode="closed-loop")
    assert (code, verdict["label"], decisive(verdict)) == (1, "controller failed", {"controller": "failed"})
    assert "constraints could not be satisfied at 1 of 1 steps (1 relaxed)" in verdict["sentence"]


def test_a_goal_that_is_not_reached_fails_alone(stage: Stage) -> None:
    code, verdict = stage.judged("--set", "control.max_time=0.3", mode="closed-loop")
    assert (code, verdict["label"], decisive(verdict)) == (1, "goal not reached", {"goal": "failed"})


def test_a_scene_that_comes_into_the_driven_arm_is_a_hit(stage: Stage) -> None:
    stage.states, stage.later = passing(), [ball_beside(stage.arm, START + 0.3 * MOVE, -0.02)]
    code, verdict = stage.judged(mode="closed-loop")
    assert (code, decisive(verdict)["scene hits"]) == (1, "failed")
    (hit,) = [r for r in verdict["reasons"] if r["criterion"] == "scene hits"]
    assert (hit["value"], hit["time_s"]) == (1, pytest.approx(0.5, abs=0.02))


def test_a_person_beside_the_driven_arm_is_no_hit_although_the_controller_keeps_further_off(
    stage: Stage,
) -> None:
    stage.states, stage.later = passing(), [ball_beside(stage.arm, START + 0.3 * MOVE, 0.05)]
    stage.are_later_people = True
    _, verdict = stage.judged("--set", "control.human_margin=0.25", mode="closed-loop")
    assert stage.desk.metrics()["num_scene_hits"] == 0 and "scene hits" not in decisive(verdict)


def test_what_came_while_the_arm_was_driven_and_the_next_map_shows_is_a_hit(stage: Stage) -> None:
    """The loop ends between two maps; the first map after it has a ball where the arm now stands."""
    assert stage.judged(mode="closed-loop")[0] == 0
    end_ns = int(stage.desk.rows()[-1]["stamp_ns"])
    stage.map_stamps = [*range(0, end_ns, QUARTER), end_ns + QUARTER // 10]
    stage.later, stage.later_from = [ball_beside(stage.arm, START + MOVE, -0.02)], end_ns
    code, verdict = stage.judged(mode="closed-loop", scene=stage.scene("later"))
    assert (code, decisive(verdict)) == (1, {"scene hits": "failed", "map age": "not evaluable"})
    stage.map_stamps = [*stage.map_stamps[:-1], end_ns + 10 * SECOND]
    assert stage.judged(mode="closed-loop", scene=stage.scene("much later"))[0] == 0


@pytest.mark.parametrize(("offset", "uncertainty", "code"), [(0.2, 0.02, 5), (-0.2, 0.02, 5), (0.06, 0.02, 0)])
def test_clocks_that_disagree_turn_the_verdict_alone(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, offset: float, uncertainty: float, code: int
) -> None:
    clock = ClockOffset(offset_s=offset, uncertainty_s=uncertainty, correlation=0.9, num_intervals=50)
    monkeypatch.setattr(job, "clock_of", lambda *given: clock)
    found, verdict = stage.judged()
    assert (found, decisive(verdict)) == (code, {"clocks": "not evaluable"} if code else {})
    assert not code or ("ahead of" if offset > 0 else "behind") in verdict["sentence"]


def test_a_failure_outranks_what_cannot_be_evaluated(stage: Stage) -> None:
    in_contact(stage)
    dropped_states(stage)
    code, verdict = stage.judged()
    assert (code, decisive(verdict)) == (1, {"clearance": "failed", "judged states": "not evaluable"})
    assert "and 1 more reason" in verdict["sentence"]


@pytest.mark.parametrize(
    ("gate", "more", "code"),
    [
        *(("min_clearance>=0.1", True, 0), ("min_clearance>=5", True, 1), ("min_clearance>=5", False, 1)),
        *(("min_clearance_true>=0", True, 5), ("clock_offset_s<=1", False, 5), ("max_pose_position<=0.01", True, 5)),
    ],
)
def test_a_gate_turns_the_verdict_with_report_only_too(stage: Stage, gate: str, more: bool, code: int) -> None:
    found, verdict = stage.judged("--require", gate, *["--report-only"] * more)
    assert (found, set(decisive(verdict))) == (code, {f"--require {gate}"} if code else set()), verdict["sentence"]


@pytest.mark.parametrize(
    ("gate", "passes"), [("max_acceleration_share<=1", ("--set", "control.max_acceleration=9")), ("num_poses<=0", ())]
)
def test_a_gate_on_what_nothing_was_measured_of_is_not_evaluable(
    stage: Stage, gate: str, passes: tuple[str, ...]
) -> None:
    scene = stage.scene()
    code, verdict = stage.judged("--require", gate, scene=scene)
    assert verdict["counts"]["min_clearance"] == 11 and set(verdict["counts"]) == set(stage.desk.metrics())
    if passes:
        assert (code, decisive(verdict)) == (5, {f"--require {gate}": "not evaluable"})
        assert "as it rests on nothing" in verdict["sentence"]
    assert stage.judged("--require", gate, *passes, scene=scene)[0] == 0


@pytest.mark.parametrize(
    ("link", "end", "code", "said"),
    [
        ("hand", 9.0, 0, "contact of hand declared (grasps the ball): "),
        ("hand", 0.1, 1, "warning: not used by any state"),
        ("link2", 9.0, 1, "warning: not used by any state"),
    ],
)
def test_contact_that_is_declared_is_left_out_and_listed(
    stage: Stage, tmp_path: Path, link: str, end: float, code: int, said: str
) -> None:
    """Only of its link and within its time; an entry that nothing used is a warning."""
    in_contact(stage)
    entry = f'link = "{link}"\nbox = [-2, -2, -2, 2, 2, 2]\nstart = 0\nend = {end}\nreason = "grasps the ball"\n'
    (tmp_path / "declared.toml").write_text(f"[[expected_contact]]\n{entry}")
    found, verdict = stage.judged("--declare", str(tmp_path / "declared.toml"))
    assert found == code, verdict["sentence"]
    assert any(said in note for note in verdict["notes"])
