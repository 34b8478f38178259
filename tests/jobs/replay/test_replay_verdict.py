"""Every criterion of a replay's verdict turns it when it alone is broken."""

import re
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
    DISPLACED_CAMERA,
    DROPPED_STATES,
    ELSEWHERE,
    GAP_IN_THE_LOG,
    IN_CONTACT,
    LATE_MAPS,
    NEAR_MARGIN,
    NO_NEW_MAP,
    TURN,
    Change,
    break_by,
)
from tests.jobs.stage import (
    FAR,
    MOVE,
    QUARTER,
    Beside,
    Stage,
    beside_the_mount,
    decisive,
    passing,
    resting,
    states_on,
    unseen_about,
    voxels,
)


@pytest.mark.parametrize("mode", ["audit", "open-loop", "closed-loop"])
def test_a_run_with_nothing_broken_is_safe(stage: Stage, mode: str) -> None:
    verdict = stage.expect(0, {}, mode=mode, label="safe", says="map error not measured")
    assert verdict["outcome"] == "passed" and all(reason["count"] for reason in verdict["reasons"])
    assert {"clearance", "self-clearance", "position limits", "velocity limits", "surface clearance"} <= {
        reason["criterion"] for reason in verdict["reasons"]
    }


def test_what_asks_for_less_than_the_defaults_stands_in_the_sentence(stage: Stage) -> None:
    laxer = ("--max-map-age=100", "--max-unknown=0.5", "--set=verdict.lead_in=2", "--set=control.margin=0.01")
    verdict = stage.expect(0, {}, *laxer, "--set=verdict.confidence=0.999")
    assert [note for note in verdict["notes"] if note.startswith("waived: ")] == [
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


@pytest.mark.parametrize("name", ALONE)
def test_one_criterion_that_is_broken_turns_the_verdict_and_names_itself(stage: Stage, name: str) -> None:
    broken, arguments, criterion, label, words = ALONE[name]
    break_by(stage, broken)
    code, outcome = (5, label) if label == "not evaluable" else (1, "failed")
    stage.expect(code, {criterion: outcome}, *arguments, label=label, says=words)
    assert not criterion.startswith(REQUESTED), "with --report-only it turns no exit code"


def test_a_broken_margin_says_when_where_and_who(stage: Stage) -> None:
    break_by(stage, NEAR_MARGIN)
    _, verdict = stage.judged()
    worst, (center, radius) = verdict["reasons"][0], stage.balls[1]
    assert (worst["value"], worst["threshold"], worst["count"]) == (pytest.approx(0.01, abs=1e-5), 0.02, 11)
    assert worst["who"].startswith("hand[") and worst["time_s"] == pytest.approx(1.0)
    assert np.linalg.norm(np.array(worst["place"]) - center) == pytest.approx(radius, abs=1e-5)
    assert stage.judged("--report-only", scene=stage.desk.folder / "scene")[0] == 0


NOT_EVALUABLE, FAILED = "not evaluable", "failed"
OTHER_HOUR = states_on(np.tile(START, (11, 1)), start_ns=3600 * SECOND)
AT_MOUNT = [FAR, Beside(0.015, is_at_mount=True)]
DEAD = ("--mode=closed-loop", "--controller-command", "sh -c 'read a; echo {\\\"protocol\\\":1}'")
CONCLUDED: dict[str, tuple[Change, tuple[str, ...], int, dict[str, str], str, str]] = {
    "the margin is kept up to what a solver leaves": (
        {"states": resting(), "balls": [FAR, Beside(0.0195, START)]},
        (),
        0,
        {},
        "safe",
        "",
    ),
    "and no further": (
        {"states": resting(), "balls": [FAR, Beside(0.0185, START)]},
        (),
        1,
        {"clearance": FAILED},
        "margin broken",
        "",
    ),
    "what comes nearer to a fixed sphere that stood free counts": (  # by less than what a mount's map grows
        {"balls": [FAR, Beside(0.042, is_at_mount=True)], "later": [Beside(0.0155, is_at_mount=True)]},
        (),
        1,
        {"static clearance": FAILED},
        "margin broken",
        "",
    ),
    "what comes a little nearer to a mount does not count": (
        {"balls": AT_MOUNT, "later": [Beside(-0.010, is_at_mount=True)]},
        (),
        0,
        {},
        "safe",
        "",
    ),
    "what comes much nearer to a mount counts": (
        {"balls": AT_MOUNT, "later": [Beside(-0.016, is_at_mount=True)]},
        (),
        1,
        {"static clearance": FAILED},
        "contact",
        "",
    ),
    "a gap of 0.4 s that the arm cannot use is bounded": (
        {"states": [*resting()[:4], *resting()[7:]], "balls": [((-4.0, 0.0, 1.3), 0.05)]},
        (),
        0,
        {},
        "safe",
        "",
    ),
    "a goal that is not reached fails alone": (
        {},
        ("--mode=closed-loop", "--set=control.max_time=0.3"),
        1,
        {"goal": FAILED},
        "goal not reached",
        "",
    ),
    "a user's controller that fails is not doubted for a displaced camera": (
        DISPLACED_CAMERA,
        DEAD,
        1,
        {"calibration": NOT_EVALUABLE, "goal": FAILED, "controller": FAILED},
        "controller failed",
        "",
    ),
    "a failure outranks what cannot be evaluated": (
        {**IN_CONTACT, **DROPPED_STATES},
        (),
        1,
        {"clearance": FAILED, "judged states": NOT_EVALUABLE},
        "contact",
        "and 1 more reason",
    ),
    "states of another hour are not judged by a scene": (
        {"states": OTHER_HOUR},
        (),
        5,
        dict.fromkeys(("map age", "evidence age", "evidence"), NOT_EVALUABLE),
        NOT_EVALUABLE,
        "",
    ),
    "states of another hour are not judged by a field": (
        {"states": OTHER_HOUR, "baked": {"moment_ns": SECOND}},
        (),
        5,
        {"map age": NOT_EVALUABLE},
        NOT_EVALUABLE,
        "",
    ),
    "a field that does not say of what time it is is no evidence": (
        {"baked": {}},
        (),
        5,
        {"map age": NOT_EVALUABLE},
        NOT_EVALUABLE,
        "the baked field has no time",
    ),
    "a value of the grid below the margin is red": (
        {"baked": {}, **IN_CONTACT},
        (),
        1,
        {"clearance": FAILED, "certified clearance": FAILED, "map age": NOT_EVALUABLE},
        "contact",
        "",
    ),
}


@pytest.mark.parametrize("name", CONCLUDED)
def test_a_run_comes_to_its_conclusion(stage: Stage, name: str) -> None:
    change, arguments, code, broken, label, words = CONCLUDED[name]
    break_by(stage, change)
    stage.expect(code, broken, *arguments, label=label, says=words)


def test_what_a_displaced_camera_shows_beside_the_arm_may_be_the_arm_itself_and_what_no_map_shows_is_not_doubted(
    stage: Stage,
) -> None:
    break_by(stage, {**DISPLACED_CAMERA, **IN_CONTACT})
    broken = dict.fromkeys(("calibration", "clearance"), NOT_EVALUABLE)
    verdict = stage.expect(5, broken, label=NOT_EVALUABLE, says="cam0 sees the robot 9.0 mm")
    assert verdict["reasons"][0]["who"] == "cam0"
    stage.true = stage.balls
    verdict = stage.expect(1, broken | {"true clearance": FAILED}, scene=stage.desk.folder / "scene", label="contact")
    assert verdict["reasons"][0]["criterion"] == "true clearance"


def test_an_object_that_may_be_a_part_of_the_arm_does_not_fail_a_driven_motion(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    break_by(stage, IN_CONTACT)
    scene, brief = stage.scene(), ("--set", "control.max_time=0.5")
    assert stage.judged(*brief, scene=scene, mode="closed-loop")[0] == 1
    found = ("fore", "moves too little (3 of 5 configurations)")
    monkeypatch.setattr("splatctrl_cli.jobs.replay.replay.unlearned_link", lambda judged: found)
    assert stage.judged(*brief, scene=scene, mode="closed-loop")[0] == 5
    stage.expect(1, {"clearance": FAILED}, scene=scene, label="contact")  # of the logged motion only the link is


def test_a_field_knows_that_a_camera_of_its_scene_was_displaced(stage: Stage) -> None:
    break_by(stage, DISPLACED_CAMERA)
    stage.balls = [FAR, Beside(-0.01, START)]
    field = stage.desk.folder / "field"
    assert main(["sdf-bake", str(stage.scene()), "-o", str(field), "-q"]) == 0
    code, verdict = stage.replayed("--field", str(field))
    assert (code, verdict["label"], verdict["reasons"][0]["criterion"]) == (5, "not evaluable", "calibration")
    assert decisive(verdict)["certified clearance"] == "not evaluable"


@pytest.mark.parametrize(("gap", "label"), [(0.01, "margin broken"), (-0.01, "contact")])
def test_the_truth_alone_turns_the_verdict(stage: Stage, gap: float, label: str) -> None:
    stage.true = [FAR, Beside(gap)]
    verdict = stage.expect(1, {"true clearance": FAILED}, label=label, says="near ball1")
    assert verdict["reasons"][0]["value"] == pytest.approx(gap, abs=1e-5)


def test_contact_by_the_truth_is_contact_where_the_map_only_breaks_the_margin(stage: Stage) -> None:
    stage.balls, stage.true = [FAR, Beside(0.01)], [FAR, Beside(-0.01)]
    broken = dict.fromkeys(("true clearance", "clearance"), FAILED)
    verdict = stage.expect(1, broken, label="contact", says="true clearance: hand")
    assert verdict["sentence"].startswith("replay: CONTACT")


def test_what_stands_at_the_mount_from_the_start_is_only_said(stage: Stage) -> None:
    stage.balls = [FAR, Beside(-0.01, is_at_mount=True)]
    verdict = stage.expect(0, {})
    listed = stage.desk.json("events.json")["static_violations"]
    nearest = min(listed, key=lambda one: one["clearance"])
    assert nearest["clearance"] < 0 and nearest["sphere"].startswith("link0[")
    assert any(f"{len(listed)} fixed spheres within the margin" in note for note in verdict["notes"])


def test_what_is_seen_at_a_mount_for_the_first_time_did_not_come(stage: Stage) -> None:
    """A camera on the hand sees the table about its base when it turns there."""
    stage.later = [beside_the_mount(stage.arm)]
    stage.last_seen = unseen_about(stage.later[0][0], 0.1)
    stage.expect(0, {})


def test_acceleration_limits_count_where_they_are_set(stage: Stage) -> None:
    seconds = np.arange(11)[:, None] * 0.05
    stage.states = states_on(START + 0.5 * 4.0 * seconds**2 * TURN, step_ns=SECOND // 20)
    scene = stage.scene()
    limit = ("--set", "control.max_acceleration=1")
    stage.expect(1, {"acceleration limits": "failed"}, *limit, scene=scene, says="joint1 reaches")
    assert stage.judged("--set", "control.max_acceleration=3", scene=scene)[0] == stage.judged(scene=scene)[0] == 0


@pytest.mark.parametrize("height", [0.35, 0.6])
def test_unknown_space_counts_from_the_share_that_is_allowed(stage: Stage, height: float) -> None:
    above = grid_seen().origin[2] + 0.1 * np.arange(40) > height
    stage.last_seen = voxels(is_known=~above)
    scene = stage.scene()
    stage.judged(scene=scene)
    share = stage.desk.metrics()["unknown_share"]
    assert (height < 0.5) == (share > 0.5) and 0.05 < share < 0.95
    for allowed, code in ((share - 1e-3, 5), (share + 1e-3, 0)):
        broken = {"known space": NOT_EVALUABLE} if code else {}
        verdict = stage.expect(code, broken, "--max-unknown", str(allowed), scene=scene)
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


@pytest.mark.parametrize(
    ("reach", "options", "code", "broken", "how", "words"),
    [
        (0.0, (), 0, {}, "proven", "SAFE, proven ("),
        (0.15, (), 0, {}, "", "of the space within the margin of the arm was assumed to be free"),
        (0.0, ("--max-map-age", "9"), 0, {}, "waived", "SAFE, waived ("),
        (0.15, ("--require-proof",), 5, {"known space": NOT_EVALUABLE}, "", "NOT EVALUABLE"),
        (0.15, ("--unseen", "occupied"), 1, {"known space": FAILED}, "", "MARGIN BROKEN"),
    ],
)
def test_what_the_arm_has_about_it_is_said_of_a_safe_run(
    stage: Stage, reach: float, options: tuple[str, ...], code: int, broken: dict[str, str], how: str, words: str
) -> None:
    """All of it seen free is proven, a part that was not is assumed, and waivers come before both."""
    stage.last_seen = unseen_about(stage.arm.sphere_centers(stage.states[-1].position)[-1], reach)
    assert stage.expect(code, broken, *options, says=words)["how"] == how


def test_what_was_known_about_the_arm_is_a_criterion_where_it_suffices_too(stage: Stage) -> None:
    stage.states = passing(1.8 * TURN)
    passed = {(r["criterion"], r["value"], r["threshold"]) for r in stage.expect(0, {})["reasons"]}
    metrics = stage.desk.metrics()
    assert passed >= {
        ("known space", metrics["max_unseen_share"], UNSEEN),
        ("known space", metrics["unknown_share"], 0.05),
        ("evidence age", metrics["max_evidence_age_s"], 1.0),
    }


@pytest.mark.parametrize(
    ("broken", "allowed", "too_little"),
    [
        (NO_NEW_MAP, "--max-map-age=1.76", "--max-map-age=1.74"),
        (GAP_IN_THE_LOG, "--set=verdict.unjudged=0.51", "--set=verdict.unjudged=0.49"),
    ],
)
def test_a_map_may_be_as_old_and_as_much_time_unjudged_as_is_said(
    stage: Stage, broken: Change, allowed: str, too_little: str
) -> None:
    break_by(stage, broken)
    scene = stage.scene()
    assert (stage.judged(allowed, scene=scene)[0], stage.judged(too_little, scene=scene)[0]) == (0, 5)


def test_a_margin_that_only_the_grids_bound_breaks_is_a_matter_of_the_grid(stage: Stage) -> None:
    stage.balls, stage.baked = [FAR, Beside(0.03)], {"voxel": 0.08, "moment_ns": SECOND}
    verdict = stage.expect(5, {"certified clearance": NOT_EVALUABLE})
    found = re.search(r"bake again with --voxel at most ([\d.]+)", verdict["sentence"])
    assert 0.005 < float(found[1]) < 0.08


def test_after_a_long_lead_in_the_rest_can_be_judged_as_the_remedy_says(stage: Stage) -> None:
    break_by(stage, LATE_MAPS)
    scene = stage.scene()
    code, verdict = stage.judged(scene=scene)
    assert code == 5 and "judge the rest alone with --start-time first-map" in verdict["sentence"]
    assert stage.desk.metrics()["unjudged_s"] == pytest.approx(0.6)
    verdict = stage.expect(0, {}, "--start-time", "first-map", scene=scene)
    assert "from 0.60 to 1.00 s of the log" in verdict["scope"]


def test_a_short_lead_in_is_left_out_and_said(stage: Stage) -> None:
    stage.map_stamps = [SECOND // 2, SECOND]
    assert "0.50 s before the first map are left out" in stage.expect(0, {})["notes"]


def test_a_controller_that_cannot_keep_its_rows_fails_alone(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatctrl_cli.jobs.replay.inputs.kept_margins", lambda *_: ())  # no pair keeps less
    options = ("--set", "control.self_margin=0.06", "--goal-joints=" + ",".join(str(v) for v in START))
    words = "constraints could not be satisfied at 1 of 1 steps (1 relaxed)"
    stage.expect(1, {"controller": FAILED}, *options, mode="closed-loop", label="controller failed", says=words)


def test_a_scene_that_comes_into_the_driven_arm_is_a_hit(stage: Stage) -> None:
    stage.later = [Beside(-0.02, START + 0.3 * MOVE)]
    code, verdict = stage.judged(mode="closed-loop")
    assert (code, decisive(verdict)["scene hits"]) == (1, "failed")
    (hit,) = [r for r in verdict["reasons"] if r["criterion"] == "scene hits"]
    assert (hit["value"], hit["time_s"]) == (1, pytest.approx(0.5, abs=0.02))


def test_a_person_beside_the_driven_arm_is_no_hit_although_the_controller_keeps_further_off(
    stage: Stage,
) -> None:
    stage.later, stage.are_later_people = [Beside(0.05, START + 0.3 * MOVE)], True
    _, verdict = stage.judged("--set", "control.human_margin=0.25", mode="closed-loop")
    assert stage.desk.metrics()["num_scene_hits"] == 0 and "scene hits" not in decisive(verdict)


def test_what_came_while_the_arm_was_driven_and_the_next_map_shows_is_a_hit(stage: Stage) -> None:
    """The loop ends between two maps; the first map after it has a ball where the arm now stands."""
    assert stage.judged(mode="closed-loop")[0] == 0
    end_ns = int(stage.desk.rows()[-1]["stamp_ns"])
    stage.map_stamps = [*range(0, end_ns, QUARTER), end_ns + QUARTER // 10]
    stage.later, stage.later_from = [Beside(-0.02, START + MOVE)], end_ns
    stage.expect(1, {"scene hits": FAILED, "map age": NOT_EVALUABLE}, mode="closed-loop", scene=stage.scene("later"))
    stage.map_stamps = [*stage.map_stamps[:-1], end_ns + 10 * SECOND]
    assert stage.judged(mode="closed-loop", scene=stage.scene("much later"))[0] == 0


@pytest.mark.parametrize(("offset", "code", "words"), [(0.2, 5, "ahead of"), (-0.2, 5, "behind"), (0.06, 0, "")])
def test_clocks_that_disagree_turn_the_verdict_alone(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, offset: float, code: int, words: str
) -> None:
    clock = ClockOffset(offset_s=offset, uncertainty_s=0.02, correlation=0.9, num_intervals=50)
    monkeypatch.setattr(job, "clock_of", lambda *given: clock)
    stage.expect(code, {"clocks": "not evaluable"} if code else {}, says=words)


@pytest.mark.parametrize(
    ("gate", "more", "code"),
    [
        *(("min_clearance>=0.1", True, 0), ("min_clearance>=5", True, 1), ("min_clearance>=5", False, 1)),
        *(("min_clearance_true>=0", True, 5), ("clock_offset_s<=1", False, 5), ("max_pose_position<=0.01", True, 5)),
    ],
)
def test_a_gate_turns_the_verdict_with_report_only_too(stage: Stage, gate: str, more: bool, code: int) -> None:
    broken = {f"--require {gate}": {1: FAILED, 5: NOT_EVALUABLE}[code]} if code else {}
    stage.expect(code, broken, "--require", gate, *["--report-only"] * more)


def test_a_gate_on_what_nothing_was_measured_of_is_not_evaluable(stage: Stage) -> None:
    gate, scene = ("--require", "max_acceleration_share<=1"), stage.scene()
    words, broken = "as it rests on nothing", {" ".join(gate): NOT_EVALUABLE}
    counts = stage.expect(5, broken, *gate, scene=scene, says=words)["counts"]
    assert counts["min_clearance"] == 11 and set(counts) == set(stage.desk.metrics())
    for measured in ((*gate, "--set", "control.max_acceleration=9"), ("--require", "num_poses<=0")):
        stage.expect(0, {}, *measured, scene=scene)


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
    break_by(stage, IN_CONTACT)
    entry = f'link = "{link}"\nbox = [-2, -2, -2, 2, 2, 2]\nstart = 0\nend = {end}\nreason = "grasps the ball"\n'
    (tmp_path / "declared.toml").write_text(f"[[expected_contact]]\n{entry}")
    verdict = stage.expect(code, {"clearance": FAILED} if code else {}, "--declare", str(tmp_path / "declared.toml"))
    assert any(said in note for note in verdict["notes"])
