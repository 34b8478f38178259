"""A table that an arm and a person share (IV, human-robot study).

The arm carries from left to right; the person's arm reaches in from across, takes a pile of cubes apart beside the
arm's pickup or its goal, and leaves. The person leans on the table's far edge; upper arm and forearm are two links
with the elbow out and down, the hand a third capsule. The cubes stay where they are. World frame as in `tabletop`.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from splatctrl_cli.blocks import (
    START_NS,
    Float64,
    Motion,
    Primitive,
    Scene,
    Track,
    box,
    frame_along,
    furniture,
    pose_at,
    solid,
    texture,
)

PLACES = ("near-pickup", "near-goal")

# Joint positions [rad] of the task: home, the hand over the pickup (y = 0.34 m), over the bowl (y = -0.34 m), home.
HOME = (0.0, -0.287, 0.0, -2.581, 0.0, 2.294, 0.785)
PICKUP = (0.613, 0.425, 0.003, -2.08, -0.002, 2.505, 1.403)
BOWL = (-0.613, 0.425, -0.003, -2.08, 0.002, 2.505, 0.168)
TASK = (HOME, PICKUP, BOWL, HOME)
LEG_S, PAUSE_S = 3.0, 0.3  # [s] of each leg of the logged motion, and the rest before it
DURATION_S = 24.0  # [s] in which every visit and every logged motion ends

UPPER_ARM, FOREARM, HAND = (0.050, 0.33), (0.042, 0.28), (0.038, 0.09)  # radius, length [m]
SHOULDER = (1.05, 0.42)  # [m] x, z: of a sitting person who leans in over the table's edge at x = 1.15
CUBE = 0.04  # [m]


@dataclass(frozen=True, kw_only=True)
class Visit:
    """A seed's visit: the pile (2,) [m] on the table, the shoulder (3,) [m], the elbow's side (1: left), the wrist's
    places (W, 3) [m], and its times of arrival and departure (W,) [s].
    """

    pile: Float64
    shoulder: Float64
    side: int
    wrist: Float64
    arrival_s: Float64
    departure_s: Float64

    @property
    def start_s(self) -> float:
        """When the arm is there at first [s]."""
        return float(self.departure_s[0])

    @property
    def end_s(self) -> float:
        """When it is gone [s]."""
        return float(self.arrival_s[-1])


def visit_of(place: str, seed: int) -> Visit:
    """The visit of a seed at one of `PLACES`; side, times, places and speed (0.3 to 0.6 m/s) are random."""
    rng = np.random.default_rng([seed, PLACES.index(place)])
    left = 1.0 if place == "near-pickup" else -1.0
    side = int(rng.choice([-1, 1]))
    pile = np.array([0.62, 0.33 * left]) + rng.uniform(-0.03, 0.03, 2)
    built = pile + np.array([-0.05, -0.17 * left]) + rng.uniform(-0.02, 0.02, 2)
    shoulder = np.array([SHOULDER[0], (pile[1] + built[1]) / 2 + side * rng.uniform(0.03, 0.15), SHOULDER[1]])
    rest = np.array([SHOULDER[0] + 0.15, shoulder[1] - 0.1 * side, 0.24])
    wrist, dwell = [rest, _over(pile, 0.30)], [0.0, 0.1]
    for level in range(int(rng.integers(2, 5))):
        wrist += [_over(pile, 0.27), _over(built, 0.17 + 0.04 * level)]
        dwell += [float(rng.uniform(0.2, 0.6)) for _ in range(2)]
    wrist, dwell = [*wrist, _over(built, 0.30), rest], [*dwell, 0.1, 0.0]
    speed, clock = rng.uniform(0.3, 0.6), float(rng.uniform(0.5, 6.5))
    arrival, departure = [clock], [clock]
    for (a, b), wait in zip(pairwise(wrist), dwell[1:], strict=True):
        arrival.append(departure[-1] + max(float(np.linalg.norm(b - a)) / speed, 0.25))
        departure.append(arrival[-1] + wait)
    return Visit(
        pile=pile,
        shoulder=shoulder,
        side=side,
        wrist=np.array(wrist),
        arrival_s=np.array(arrival),
        departure_s=np.array(departure),
    )


def things(place: str, seed: int) -> list[Primitive]:
    """Objects on the table: the pile, a block at the pickup, a bowl at the goal, objects between."""
    rng = np.random.default_rng([seed, PLACES.index(place), 1])
    pile = visit_of(place, seed).pile
    cubes = [
        box(
            f"cube.{level}",
            (CUBE, CUBE, CUBE),
            (*(pile + rng.uniform(-0.008, 0.008, 2)), CUBE * (level + 0.5)),
            texture("checks", 0.05, ("brick", "sand", "moss")[level], level),
            yaw=float(rng.uniform(0.0, np.pi / 2)),
        )
        for level in range(3)
    ]
    return [
        *cubes,
        box("parcel", (0.20, 0.14, 0.06), (0.62, 0.0, 0.03), texture("noise", 0.055, "ocean", 5), yaw=0.3),
        box("block", (0.07, 0.07, 0.05), (0.48, 0.34, 0.025), texture("stripes", 0.05, "sand", 1)),
        solid("bowl", "cylinder", (0.07, 0.05), (0.48, -0.34, 0.025), texture("stripes", 0.05, "grape", 2), 0.0),
        box("book", (0.16, 0.22, 0.04), (0.30, -0.55, 0.02), texture("noise", 0.05, "moss", 6), yaw=-0.4),
    ]  # fmt: skip


def human_arm(visit: Visit, start_ns: int) -> list[Primitive]:
    """The person's upper arm, forearm and hand as moving capsules, present from the visit's start to its end."""
    num_knots = int(np.ceil((visit.end_s - visit.start_s) / 0.05)) + 1  # [s] between two poses
    seconds = np.linspace(visit.start_s, visit.end_s, num_knots)
    chains = [_chain(visit, float(second)) for second in seconds]
    stamps = start_ns + np.rint(seconds * 1e9).astype(np.int64)
    parts = (("human.upper_arm", UPPER_ARM), ("human.forearm", FOREARM), ("human.hand", HAND))
    solids = []
    for index, (name, size) in enumerate(parts):
        poses = np.stack([_along(chain[index], chain[index + 1]) for chain in chains])
        solids.append(
            Primitive(
                name=name,
                kind="capsule",
                size=size,
                T_world_shape=poses[0],
                texture=texture("noise", 0.05, "brick" if index == 2 else "grape", 9),
                from_ns=int(stamps[0]),
                to_ns=int(stamps[-1]),
                track=Track(stamp_ns=stamps, T_world_shape=poses),
            )
        )
    return solids


def task_motion(visit: Visit) -> Motion:
    """The logged motion: the task leg by leg, but no leg while the person's arm is there."""
    times, waypoints, clock = [0.0], [HOME], 0.0
    for before, after in pairwise(TASK):
        depart = clock + PAUSE_S
        if depart < visit.end_s and depart + LEG_S > visit.start_s:
            depart = visit.end_s
        times += [depart, depart + LEG_S]
        waypoints += [before, after]
        clock = depart + LEG_S
    return Motion(times=np.array(times), waypoints=np.array(waypoints))


def scene_of(place: str, seed: int) -> Scene:
    """Return the table with a person's arm, whose visit the seed draws."""
    visit = visit_of(place, seed)
    person = tuple(human_arm(visit, START_NS))
    return Scene(
        primitives=(*furniture(), *things(place, seed), *person),
        temporary=person,
        motion=task_motion(visit),
        has_people=True,
    )


def _chain(visit: Visit, second: float) -> Float64:
    """Shoulder, elbow, wrist and finger tips (4, 3) [m] at a time [s]."""
    wrist = _wrist(visit, second)
    reach = wrist - visit.shoulder
    distance = float(np.linalg.norm(reach))
    direction = reach / distance
    upper, fore = UPPER_ARM[1], FOREARM[1]
    assert abs(upper - fore) < distance < upper + fore, distance
    along = (distance**2 + upper**2 - fore**2) / (2 * distance)
    out = np.array([0.0, 0.8 * visit.side, -0.6])
    out -= (out @ direction) * direction
    elbow = visit.shoulder + along * direction + np.sqrt(upper**2 - along**2) * out / np.linalg.norm(out)
    pointing = (wrist - elbow) / fore + np.array([0.0, 0.0, -0.5])
    return np.stack([visit.shoulder, elbow, wrist, wrist + HAND[1] * pointing / np.linalg.norm(pointing)])


def _wrist(visit: Visit, second: float) -> Float64:
    """The wrist's place (3,) [m]: minimum jerk between its places, where it rests."""
    index = int(np.clip(np.searchsorted(visit.arrival_s, second, side="right"), 1, len(visit.wrist) - 1))
    depart, arrive = visit.departure_s[index - 1], visit.arrival_s[index]
    s = float(np.clip((second - depart) / (arrive - depart), 0.0, 1.0))
    share = 10 * s**3 - 15 * s**4 + 6 * s**5
    return np.asarray(visit.wrist[index - 1] + share * (visit.wrist[index] - visit.wrist[index - 1]))


def _over(place: Float64, height: float) -> Float64:
    """The wrist's place (3,) [m] for a hand that reaches a place (2,) on the table."""
    return np.array([place[0] + 0.08, place[1], height])


def _along(start: Float64, end: Float64) -> Float64:
    """The pose (4, 4) of a capsule whose axis goes from start to end (3,)."""
    return pose_at((start + end) / 2, frame_along(end - start))
