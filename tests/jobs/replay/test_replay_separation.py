"""A replay's separation from people, by an independent calculation at its states."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.control.near_space import NEVER_SEEN, Seen
from splatctrl_cli.jobs.replay.separation import NO_CLAIM, unseen_cells
from splatctrl_cli.records import Float64, JointState
from splatctrl_cli.voxels import EvidenceClass
from tests.cli.replay_desk import SECOND, START
from tests.jobs.stage import FAR, MOVE, QUARTER, Stage, ball_beside, passing, resting, unseen_about
from tests.reference import separation as reference

NEWCOMER = 'who = "newcomer"\nempty_at = 0.0'
CELL = """
[person]
who = "newcomer"
empty_at = 0.0
[robot]
deceleration = 2.0
[distance]
intrusion = 0.1
"""


def separation_option(stage: Stage, text: str = CELL) -> list[str]:
    path = stage.desk.folder / "cell.toml"
    path.write_text(text)
    return ["--separation", str(path)]


def moving_on() -> list[JointState]:
    """The straight way, with its velocity."""
    return [replace(state, velocity=MOVE) for state in passing()]


def column(stage: Stage, name: str) -> Float64:
    return np.array([float(row[name] or "inf") for row in stage.desk.rows()])


def test_the_separation_from_a_ball_that_comes_is_that_of_the_formulas(stage: Stage) -> None:
    """The ball comes at 0.5 s; v_h 1.6 m/s, a map each 0.25 s, Z_d 4 cm and the map's age, Z_r 5 mm and coverage."""
    ball = ball_beside(stage.arm, passing()[-1].position, 0.2)
    stage.states, stage.balls, stage.later = moving_on(), [FAR], [ball]
    assert stage.judged(*separation_option(stage))[0] == 0
    rows, arm = stage.desk.rows(), stage.arm
    moving, tick = np.flatnonzero(arm.moving_spheres), 1e-6
    assert not any(row["separation"] for row in rows[:5])
    for index in (5, 8, 10):
        q = START + index / 10 * MOVE
        centers, later = (arm.sphere_centers(p)[moving] for p in (q, q + tick * MOVE))
        gaps = [
            np.linalg.norm(c - np.array(ball[0]), axis=1) - arm.sphere_set.radii[moving] - ball[1]
            for c in (centers, later)
        ]
        speed, toward = np.linalg.norm(later - centers, axis=1) / tick, (gaps[0] - gaps[1]) / tick
        z_d = 0.04 + 1.6 * ((index * SECOND // 10) % QUARTER) * 1e-9
        needed = []
        for v, v_r in zip(speed.tolist(), toward.tolist(), strict=True):
            t_s, s_s = reference.braking(v, float(speed.max()), 2.0)
            s_h, s_r = reference.person(1.6, 0.25, t_s), reference.reaction(v_r, 0.25)
            needed.append(reference.protective_distance(s_h, s_r, s_s, 0.1, z_d, 0.005))
        worst = int(np.argmin(gaps[0] - needed))
        found = [float(rows[index][name]) for name in ("separation", "protective_distance", "separation_margin")]
        assert found == pytest.approx([gaps[0][worst], needed[worst], gaps[0][worst] - needed[worst]], abs=1e-4)
        contact = np.min(gaps[0] / (1.6 + np.maximum(toward, 0)))
        assert float(rows[index]["time_to_contact"]) == pytest.approx(contact, abs=1e-4)


def test_figures_gate_and_inputs_say_where_they_are_from(stage: Stage) -> None:
    stage.balls, stage.later = [FAR], [ball_beside(stage.arm, passing()[-1].position, 0.2)]
    gates = ("--require", "separation_margin_min>=0", "--require", "time_below_separation<=0.3")
    code, verdict = stage.judged(*separation_option(stage), *gates)
    said = [reason["sentence"] for reason in verdict["reasons"] if reason["criterion"].startswith("--require")]
    assert code == 1 and "first at 0.500 s" in said[0] and "time_below_separation is 0.5, required <= 0.3" in said[1]
    document, metrics = stage.desk.json("separation.json"), stage.desk.metrics()
    assert document["claim"] == NO_CLAIM
    assert {each["symbol"]: (each["value"], each["source"]) for each in document["inputs"]} == {
        "person": (None, "declared"),
        "unseen": (None, "assumed"),
        "v_h": (1.6, "assumed"),
        "C": (0.1, "declared"),
        "T_r": (0.25, "measured"),
        "a": (2.0, "declared"),
        "Z_d": (0.04, "assumed"),
        "Z_r": (0.005, "assumed"),
    }
    figures = {each["name"]: each["value"] for each in document["figures"]}
    assert all(metrics[name] == value for name, value in figures.items() if name != "standstill_below_s")
    scales = column(stage, "speed_scale")
    assert scales[:5].tolist() == [1.0] * 5 and figures["standstill_below_s"] == pytest.approx(
        0.1 * np.sum(scales[5:10] == 0)
    )


def test_a_replay_without_the_option_has_no_separation(stage: Stage) -> None:
    assert stage.judged()[0] == 0
    assert "separation" not in stage.desk.rows()[0] and not (stage.desk.folder / "out" / "separation.json").exists()
    assert stage.judged("--require", "separation_margin_min>=0", scene=stage.desk.folder / "scene")[0] == 2


def test_people_are_those_with_a_label_and_the_rest_is_static(stage: Stage) -> None:
    near, far = (ball_beside(stage.arm, START, gap) for gap in (0.1, 0.4))
    stage.states, stage.balls, stage.people = resting(), [near], [far]
    assert stage.judged(*separation_option(stage, CELL.replace('"newcomer"\nempty_at = 0.0', '"labelled"')))[0] == 0
    assert column(stage, "separation").min() > 0.35
    assert column(stage, "stop_clearance") == pytest.approx(np.full(11, 0.1), abs=1e-3)
    scene = stage.desk.folder / "scene"
    stage.judged(*separation_option(stage, CELL.replace(NEWCOMER, 'unseen = "ignored"')), scene=scene)
    assert column(stage, "separation") == pytest.approx(np.full(11, 0.1), abs=1e-3)


def test_the_stopping_volume_reaches_where_the_arm_would_stop(stage: Stage) -> None:
    """The arm covers a quarter of MOVE in T_r before it stops; the ball stands 0.15 of MOVE past the last state."""
    stage.states = moving_on()
    stage.balls = [FAR, ball_beside(stage.arm, START + 1.15 * MOVE, 0.03)]
    stage.judged(*separation_option(stage))
    assert column(stage, "stop_clearance")[-1] < 0.03 and column(stage, "clearance_exact")[-1] > 0.04


def test_space_never_seen_counts_as_a_person_on_request(stage: Stage) -> None:
    hand = stage.arm.sphere_centers(START)[-1]
    stage.states, stage.last_seen = resting(), unseen_about(hand + np.array([0.0, 0.0, 0.6]), 0.2)
    for unseen, reach in (("ignored", np.inf), ("person", 0.6)):
        text = CELL.replace("[person]", f'[person]\nunseen = "{unseen}"')
        stage.judged(*separation_option(stage, text), scene=stage.scene(unseen))
        assert np.all((column(stage, "separation") < reach) == (unseen == "person"))


def test_unseen_cells_are_the_border_of_space_that_no_camera_saw() -> None:
    def look(points: Float64) -> tuple[Float64, Float64]:
        classes = np.where(points[:, 0] > 0.35, NEVER_SEEN[0], EvidenceClass.FREE)
        return np.zeros(len(points)), np.where(points[:, 1] > 0.65, EvidenceClass.SWEPT, classes)

    cells = unseen_cells(Seen(look=look, origin=np.zeros(3), voxel=0.1, shape=(8, 8, 8)))
    assert len(cells) == 4 * 7 * 8 - 2 * 5 * 6 and cells[:, 0].min() == pytest.approx(0.4)
    assert cells[:, 1].max() == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        (CELL.replace('"newcomer"\nempty_at = 0.0', '"labelled"'), 4, "no map has a surface with depth and a person"),
        (CELL.replace("0.0", "9.0"), 4, "person.empty_at: expected a time within the log, which ends after 1.00 s"),
        (CELL + '[[stop]]\naxis = "x"\n', 2, "expected [[stop]] entries or robot.deceleration, got both"),
    ],
)
def test_what_the_recording_or_the_file_lacks_is_refused(
    stage: Stage, capsys: pytest.CaptureFixture[str], text: str, code: int, words: str
) -> None:
    assert stage.judged(*separation_option(stage, text))[0] == code
    (said,) = capsys.readouterr().err.splitlines()
    assert words in said


def test_a_baked_field_and_a_single_map_are_refused(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    given = separation_option(stage)
    assert stage.replayed("--field", "field.npz", *given)[0] == 2
    stage.map_stamps = [0]
    assert stage.judged(*given)[0] == 4
    assert "declare robot.reaction_time" in capsys.readouterr().err


def test_a_driven_arm_is_judged_by_its_commands(stage: Stage) -> None:
    stage.balls = [FAR, ball_beside(stage.arm, START, 0.5)]
    stage.judged(*separation_option(stage, CELL.replace(NEWCOMER, "")), mode="closed-loop")
    speed = np.array([[float(row[f"v_joint{j}"] or 0) for j in range(1, 8)] for row in stage.desk.rows()])
    assert np.any(speed) and np.all((column(stage, "S_s") > 0) == np.any(speed != 0, axis=1))


def test_a_fast_hand_before_a_person_counts_more_than_a_slow_link_that_is_nearer(stage: Stage) -> None:
    arm, q = stage.arm, START + 0.5 * MOVE
    slow = int(np.flatnonzero(arm.moving_spheres)[0])
    behind = arm.sphere_centers(q)[slow] - np.array([arm.sphere_set.radii[slow] + 0.05 + 0.15, 0.0, 0.0])
    ahead = ball_beside(arm, START + 1.3 * MOVE, 0.05)
    stage.states, stage.balls = moving_on(), [FAR, ((behind[0], behind[1], behind[2]), 0.05), ahead]
    stage.judged(*separation_option(stage, CELL.replace(NEWCOMER, "")))
    apart = column(stage, "separation") - column(stage, "clearance_exact")
    parts = [(row["separation_part"], row["nearest_exact"]) for row in stage.desk.rows()]
    assert apart.max() > 0.01 and any(worst != nearest for worst, nearest in parts)
