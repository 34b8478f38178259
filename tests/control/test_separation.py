"""The protective separation distance against the standard's formulas and calculations by hand; its declared inputs:
what is read, and what is refused by name.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.control.separation import (
    Approach,
    ArmMotion,
    Deceleration,
    DeclaredSeparation,
    Stopping,
    StopRow,
    StopTable,
    read_separation,
)
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.records import Float64
from tests.reference import separation as reference
from tests.refused import expect_refusal

LIMIT = np.array([2.0, 1.0])
ROWS = [
    [
        StopRow(
            axis=axis,
            extension=extension,
            payload=1.0,
            speed=(0.33, 0.66, 1.0),
            time=(0.1, 0.2 + 0.1 * extension, 0.5),
            distance=(0.02, 0.1 * extension, 0.3),
        )
        for extension in (0.5, 1.0)
    ]
    for axis in "ab"
]


def motion_of(seed: int) -> ArmMotion:
    """Five states of two joints and three spheres, below the speed limits."""
    draw = np.random.default_rng(seed)
    gradient = draw.normal(size=(5, 3, 3))
    return ArmMotion(
        joint_speed=draw.uniform(-1, 1, (5, 2)) * LIMIT,
        velocity_limit=LIMIT,
        jacobian=draw.normal(size=(5, 3, 3, 2)),
        gradient=gradient / np.linalg.norm(gradient, axis=2)[:, :, None],
        extension=draw.uniform(0.1, 1.2, 5),
    )


def by_reference(motion: ArmMotion, t: int, m: int, stopping: Stopping, scale: float) -> tuple[float, float, float]:
    """S_h, S_r and S_s of a sphere, v_h = 1.6 m/s and T_r = 0.15 s."""
    dq = scale * motion.joint_speed[t]
    velocity = [motion.jacobian[t, k] @ dq for k in range(3)]
    if isinstance(stopping, Deceleration):
        fastest = max(float(np.linalg.norm(v)) for v in velocity)
        time, stop = reference.braking(float(np.linalg.norm(velocity[m])), fastest, stopping.deceleration)
    else:
        time, stop = 0.0, 0.0
        for joint, rows in enumerate(ROWS):
            row = rows[0] if motion.extension[t] <= 0.5 else rows[1]
            share = float(abs(dq[joint]) / LIMIT[joint])
            stopped = reference.between(share, dict(zip(row.speed, row.distance, strict=True)))
            stop += float(np.linalg.norm(motion.jacobian[t, m, :, joint])) * stopped
            late = reference.between(share, dict(zip(row.speed, row.time, strict=True)))
            time = max(time, late, row.time[0] if share > 1e-3 else 0.0)
    toward = -float(motion.gradient[t, m] @ velocity[m])
    return reference.person(1.6, 0.15, time), reference.reaction(toward, 0.15), stop


@pytest.mark.parametrize("stopping", [Deceleration(deceleration=1.5), StopTable(rows=ROWS)])
def test_the_travel_until_the_arm_stands_is_that_of_the_formulas(stopping: Stopping) -> None:
    motion, approach = motion_of(1), Approach(person_speed=1.6, reaction_time=0.15, stopping=stopping)
    travel = approach.travel(motion, np.full(5, 0.8))
    for t, m in np.ndindex(5, 3):
        parts = by_reference(motion, t, m, stopping, 0.8)
        found = travel.person[t], travel.reaction[t, m], travel.stopping[t, m]
        assert found == pytest.approx(parts, abs=1e-6)
        assert travel.total[t, m] + 0.3 == pytest.approx(
            reference.protective_distance(*parts, 0.1, 0.15, 0.05), abs=1e-6
        )


@pytest.mark.parametrize("stopping", [Deceleration(deceleration=1.5), StopTable(rows=ROWS)])
def test_the_speed_scale_is_the_largest_that_keeps_every_sphere_within_its_room(stopping: Stopping) -> None:
    motion, approach = motion_of(2), Approach(person_speed=1.6, reaction_time=0.15, stopping=stopping)
    room = np.array([0.2, 0.6, 1.0, 1e3, np.inf])[:, None] + np.zeros((5, 3))
    found = approach.speed_scale(motion, room)
    for t in range(3):
        scale = min(
            reference.largest_scale(
                lambda s, t=t, m=m: float(approach.travel(motion, np.full(5, s)).total[t, m]), room[t, m]
            )
            for m in range(3)
        )
        assert found[t] == pytest.approx(scale, abs=1.1e-3)
    assert found[0] == 0.0 and 0 < found[2] < 1 and found[3:].tolist() == [1.0, 1.0]


def test_an_arm_at_rest_stops_at_once_and_one_that_leaves_does_not_add_to_the_distance() -> None:
    motion = replace(motion_of(3), joint_speed=np.zeros((5, 2)))
    approach = Approach(person_speed=2.0, reaction_time=0.5, stopping=StopTable(rows=ROWS))
    assert np.all(approach.travel(motion, np.ones(5)).total == 1.0)
    leaving = replace(motion_of(3), gradient=motion_of(3).velocity)
    assert not approach.travel(leaving, np.ones(5)).reaction.any()
    assert approach.time_to_contact(motion, np.full((5, 3), 0.8)) == pytest.approx(np.full(5, 0.4))


def test_a_slow_axis_takes_the_first_time_and_one_past_its_limit_grows_with_the_speed_and_its_square() -> None:
    time, distance = ROWS[0][1].at(np.array([0.0, 0.033, 1.0, 1.2]))
    assert time.tolist() == pytest.approx([0.0, 0.1, 0.5, 0.6])
    assert distance.tolist() == pytest.approx([0.0, 0.002, 0.3, 0.432])


def test_a_stop_takes_the_next_larger_extension() -> None:
    motion = replace(motion_of(4), joint_speed=np.tile(0.66 * LIMIT, (5, 1)))
    extension: Float64 = np.array([0.2, 0.5, 0.51, 1.0, 1.3])
    stop = StopTable(rows=ROWS).stop(replace(motion, extension=extension), np.ones(5))
    assert stop.time.tolist() == pytest.approx([0.25, 0.25, 0.3, 0.3, 0.3])
    assert stop.joint_travel[:, 1].tolist() == pytest.approx([0.05, 0.05, 0.1, 0.1, 0.1])


BY_HAND = {  # a = 2 m/s^2, C = 0.1 m, map error 0.02 m; speeds are differences of the recorded positions
    "sample recording, 4.50 s: the hand beside the visitor": (
        (0.0896, 0.2586, 0.2499, 0.123, 0.200, 0.100, 0.0001),
        (1.6 * (0.200 + 0.1293), 0.0246, 0.2499 * 0.1293 / 2, 0.100 + 0.020 + 0.160 + 0.0001),  # 0.8478 in steps.csv
        -0.7582,
    ),
    "sample recording, 4.90 s: the finger": (
        (0.2668, 0.3342, 0.3231, 0.1415, 0.200, 0.100, 0.0001),
        (1.6 * (0.200 + 0.1671), 0.0283, 0.3231 * 0.1671 / 2, 0.280 + 0.0001),  # 0.9228
        -0.6561,
    ),
    "sample recording, 5.30 s: the hand": (
        (0.4015, 0.3239, 0.3135, 0.192, 0.200, 0.100, 0.0001),
        (1.6 * (0.200 + 0.16195), 0.0384, 0.3135 * 0.16195 / 2, 0.280 + 0.0001),  # 0.9231
        -0.5216,
    ),
    "arrival by MuJoCo, 1.65 s: the arm rests": (
        (0.4039, 0.0, 0.0, 0.0, 0.100, 0.050, 0.0021),
        (1.6 * 0.100, 0.0, 0.0, 0.100 + 0.020 + 0.080 + 0.0021),  # 0.3621
        0.0418,
    ),
    "arrival by MuJoCo, 1.85 s": (
        (0.2817, 0.0, 0.0, 0.0, 0.100, 0.050, 0.0021),
        (0.160, 0.0, 0.0, 0.2021),  # 0.3621
        -0.0805,
    ),
    "arrival by MuJoCo, 2.25 s": (
        (0.1059, 0.0, 0.0, 0.0, 0.100, 0.050, 0.0021),
        (0.160, 0.0, 0.0, 0.2021),  # 0.3621
        -0.2562,
    ),
    "shared workspace, 4.90 s: the arm rests, a person reaches in": (
        (0.2058, 0.0, 0.0, 0.0, 0.200, 0.100, 0.0001),
        (1.6 * 0.200, 0.0, 0.0, 0.100 + 0.020 + 0.160 + 0.0001),  # 0.6001
        -0.3943,
    ),
    "shared workspace, 13.10 s: the wrist leaves": (
        (0.4405, 0.4451, 0.4451, -0.057, 0.200, 0.100, 0.0001),
        (1.6 * (0.200 + 0.22255), 0.0, 0.4451 * 0.22255 / 2, 0.280 + 0.0001),  # 1.0058
        -0.5653,
    ),
    "shared workspace, 15.70 s: the hand leaves": (
        (0.3663, 0.1940, 0.1939, -0.193, 0.200, 0.100, 0.0001),
        (1.6 * (0.200 + 0.0970), 0.0, 0.1939 * 0.0970 / 2, 0.280 + 0.0001),  # 0.7647
        -0.3984,
    ),
}


@pytest.mark.parametrize("state", BY_HAND)
def test_states_of_recordings_are_as_calculated_by_hand(state: str) -> None:
    """A state's separation, fastest speed, the part's speed and approach, T_r, age and Z_r give terms and margin."""
    (separation, fastest, speed, toward, reaction, age, z_r), terms, replayed = BY_HAND[state]
    aside = np.sqrt(max(speed**2 - toward**2, 0.0))
    motion = ArmMotion(
        joint_speed=np.ones((1, 1)),
        velocity_limit=np.ones(1),
        jacobian=np.array([[[[toward], [aside], [0.0]], [[0.0], [fastest], [0.0]]]]),
        gradient=np.tile([-1.0, 0.0, 0.0], (1, 2, 1)),
        extension=np.ones(1),
    )
    approach = Approach(person_speed=1.6, reaction_time=reaction, stopping=Deceleration(deceleration=2.0))
    travel = approach.travel(motion, np.ones(1))
    found = travel.person[0], travel.reaction[0, 0], travel.stopping[0, 0], 0.1 + 0.02 + 1.6 * age + z_r
    assert found == pytest.approx(terms, abs=2e-4)
    assert separation - sum(terms) == pytest.approx(replayed, abs=5e-4)


BRAKING = "[robot]\ndeceleration = 2\n[distance]\nintrusion = 0.1\n"
STOP = """
[[stop]]
axis = "{}"
extension = {}
payload = {}
speed = [0.33, 0.66, 1]
time = [0.1, 0.2, 0.3]
distance = [0.01, 0.04, 0.09]
"""
HEAD = "[robot]\nreach = 0.8\npayload = 0.5\n[distance]\nintrusion = 0\n"
TABLE = HEAD + "".join(STOP.format(a, e, p) for a in "ab" for e in (0.5, 1.0) for p in (0.66, 1.0))


def declared(tmp_path: Path, text: str) -> DeclaredSeparation:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return read_separation(path, ["a", "b"])


def test_a_declared_deceleration_or_stop_table_is_how_the_arm_stops(tmp_path: Path) -> None:
    assert declared(tmp_path, BRAKING).stopping("ab") == Deceleration(deceleration=2.0)
    table = declared(tmp_path, TABLE).stopping("ab")
    assert isinstance(table, StopTable)
    assert [[(r.axis, r.extension, r.payload) for r in rows] for rows in table.rows] == [
        [(axis, 0.5, 0.66), (axis, 1.0, 0.66)] for axis in "ab"
    ]
    assert table.rows[0][0].at(np.array([0.0, 0.33, 0.495]))[1].tolist() == pytest.approx([0.0, 0.01, 0.025])


WRONG = {
    "unknown key label; known here: who": BRAKING + "[person]\nlabel = 1\n",
    "unknown key robots; did you mean robot?": "[robots]\nreach = 1\n",
    "who: expected anything, labelled or newcomer, got 'someone'": BRAKING + "[person]\nwho = 'someone'\n",
    "person.empty_at: expected with who = 'newcomer', missing; give the time": BRAKING
    + "[person]\nwho = 'newcomer'\n",
    "reaction_time: expected 0 to 60 s, got -0.1": BRAKING.replace("[robot]", "[robot]\nreaction_time = -0.1"),
    "speed: expected 0 to 20 m/s, got True": BRAKING + "[person]\nspeed = true\n",
    "distance.intrusion: missing; declare C": "[robot]\ndeceleration = 2\n",
    "or robot.deceleration, got neither": "[distance]\nintrusion = 0\n",
    "or robot.deceleration, got both": BRAKING + STOP.format("a", 1, 1),
    "stop 1: time: missing": TABLE.replace("time = [0.1, 0.2, 0.3]\n", "", 1),
    "stop 1: speed: expected shares that rise to 1, got [0.33, 0.66, 0.9]": TABLE.replace(
        "0.66, 1]", "0.66, 0.9]", 1
    ),
    "stop 1: time: expected 0 to 1000, got -0.1": TABLE.replace("[0.1,", "[-0.1,", 1),
    "stop 1: distance: expected values that rise with the speed": TABLE.replace("0.04, 0.09", "0.04, 0.03", 1),
    "missing axis, extension, payload: b, 0.5, 0.66": HEAD
    + "".join(STOP.format("a", e, p) for e in (0.5, 1.0) for p in (0.66, 1.0)),
    "missing axis, extension, payload: b, 1.0, 1.0; declare every axis": TABLE.removesuffix(
        STOP.format("b", 1.0, 1.0)
    ),
    "an axis, extension and payload is given twice": TABLE + STOP.format("b", 1.0, 1.0),
    "unknown axis c; the robot has a, b": TABLE + STOP.format("c", 1.0, 1.0),
    "expected a payload of at least 1, got 0.66": TABLE.replace("payload = 0.5", "payload = 1").replace(
        "payload = 1.0", "payload = 0.1"
    ),
    "robot.reach: missing, for stops by extension": TABLE.replace("reach = 0.8\n", ""),
    "not valid TOML": "[person\n",
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_file_is_refused_by_the_key_and_a_remedy(words: str, tmp_path: Path) -> None:
    assert expect_refusal(words, declared, tmp_path, WRONG[words], error=UsageError).startswith(str(tmp_path))


def test_a_missing_file_is_missing_input(tmp_path: Path) -> None:
    expect_refusal(
        "cannot be read", read_separation, tmp_path / "cell.toml", ["a"], error=InputError, has_remedy=True
    )
