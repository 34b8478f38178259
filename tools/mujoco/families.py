"""The families of recordings: each one's objects near the robot, and its camera faults."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from tools.mujoco.images import Camera
from tools.mujoco.poses import Float64, pose, turn_along, turn_rpy
from tools.mujoco.robots import Robot
from tools.mujoco.solids import Solid, Track, fixed
from tools.mujoco.stage import DURATION_S, Make, Stage, draw_lens, draw_thing, travelling

CLEAR, NEAR, MARGIN = (0.060, 0.150), (0.025, 0.060), 0.020  # [m]
SKIN = (0.80, 0.62, 0.52)


@dataclass(frozen=True, kw_only=True)
class Family:
    """Kind of recording. draw: fills a stage; is_at_rest: the robot does not move; share: of a campaign."""

    draw: Callable[[Stage], None]
    is_at_rest: bool = False
    share: int = 1


def wanted(rng: np.random.Generator, contact: float = 0.2, margin: float = 0.1) -> float:
    """A clearance [m]: in contact, inside the margin, near (25 to 60 mm), or clear, drawn by shares."""
    u = rng.random()
    if u < contact:
        return -float(rng.uniform(0.002, 0.02))
    if u < contact + margin:
        return float(rng.uniform(0.005, MARGIN))
    return float(rng.uniform(*(NEAR if rng.random() < 0.6 else CLEAR)))


def clear(stage: Stage) -> None:
    """Leave the space about the robot empty."""


def near(stage: Stage) -> None:
    """A thing beside the way, 5 to 60 mm and more."""
    stage.put(_thing(stage), wanted(stage.rng, 0.0))


def contact(stage: Stage) -> None:
    """The arm runs 2 to 20 mm into a thing."""
    stage.put(_thing(stage), -float(stage.rng.uniform(0.002, 0.02)))


def shelf(stage: Stage) -> None:
    """The robot reaches into a shelf: boards above and below the tip, a back, sometimes sides."""
    rng = stage.rng
    tip = stage.tip(DURATION_S)[:3, 3]
    gap, wide = float(rng.uniform(0.16, 0.24)), float(rng.uniform(0.26, 0.34))
    has_sides = rng.random() < 0.3

    def make(place: Float64) -> Sequence[Solid]:
        x, y = float(place[0]) + 0.16, float(tip[1])
        levels = sorted({0.01, max(float(tip[2]) - gap, 0.01), float(tip[2]) + gap})
        top = levels[-1]
        boards = [_board(f"board{k}", (0.16, wide, 0.01), (x, y, z)) for k, z in enumerate(levels)]
        ends = (-1, 1) if has_sides else ()
        sides = [_board(f"side{k}", (0.16, 0.01, top / 2), (x, y + s * wide, top / 2)) for k, s in enumerate(ends)]
        return [*boards, *sides, _board("back", (0.01, wide, top / 2), (x + 0.16, y, top / 2))]

    stage.put(make, wanted(rng, 0.1), second=DURATION_S, aside=np.array([1.0, 0.0, 0.0]))


def rods(stage: Stage) -> None:
    """One to three rods of 5 to 10 mm, upright or leaning."""
    rng = stage.rng
    for number in range(int(rng.integers(1, 4))):
        radius, half = float(rng.uniform(0.0025, 0.005)), float(rng.uniform(0.15, 0.3))
        turn = turn_along(np.array([*rng.uniform(-0.3, 0.3, 2), 1.0]))
        rgb = (0.2, 0.2, 0.22) if rng.random() < 0.5 else (0.75, 0.3, 0.2)

        def make(
            place: Float64,
            name: str = f"rod{number}",
            size: tuple[float, float] = (radius, half),
            turn: Float64 = turn,
            rgb: tuple[float, float, float] = rgb,
        ) -> Sequence[Solid]:
            T = pose((place[0], place[1], max(float(place[2]), size[1] + 0.01)), turn)
            return [Solid(name=name, kind="cylinder", size=size, track=fixed(T), rgb=rgb)]

        stage.put(make, wanted(rng))


def arrive(stage: Stage) -> None:
    """A thing comes to the resting arm at 0.2 to 1 m/s, and stays."""
    rng = stage.rng
    at, speed, way = float(rng.uniform(1.6, 2.8)), float(rng.uniform(0.2, 1.0)), _heading(rng)
    base = _thing(stage)
    times = [at - 0.7 / speed, at]
    stage.put(
        lambda place: travelling(base(place), times, np.array([-0.7 * way, 0 * way])), wanted(rng, 0.4), at_start=0.1
    )


def leave(stage: Stage) -> None:
    """A thing stands beside the resting arm, and goes."""
    rng = stage.rng
    at, speed, way = float(rng.uniform(1.0, 2.0)), float(rng.uniform(0.2, 1.0)), _heading(rng)
    base = _thing(stage)
    times = [at, at + 0.9 / speed]
    stage.put(lambda place: travelling(base(place), times, np.array([0 * way, 0.9 * way])), wanted(rng, 0.2, 0.1))


def roll(stage: Stage) -> None:
    """A ball or can rolls past at 0.3 to 1 m/s."""
    rng = stage.rng
    radius, speed, way = float(rng.uniform(0.03, 0.08)), float(rng.uniform(0.3, 1.0)), _heading(rng)
    at = float(rng.uniform(1.2, 2.8))
    times = [at - 0.7 / speed, at + 0.7 / speed]

    def make(place: Float64) -> Sequence[Solid]:
        z = max(radius, float(place[2]) - 0.5 * radius)
        ball = Solid(
            name="ball", kind="ball", size=(radius,), track=fixed(pose((place[0], place[1], z))), rgb=(0.8, 0.35, 0.2)
        )
        return travelling([ball], times, np.array([-0.7 * way, 0.7 * way]))

    stage.put(make, wanted(rng), at_start=0.06)


def person(stage: Stage) -> None:
    """A person beside the table reaches in with one arm, stays a while, and draws back."""
    rng = stage.rng
    at, speed, stays = float(rng.uniform(1.2, 2.4)), float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.2, 0.9))
    angle = float(rng.uniform(-1.0, 1.0))
    away = np.array([np.cos(angle), np.sin(angle), 0.0])
    times = [at - 0.5 / speed, at, at + stays, at + stays + 0.5 / speed]

    def make(place: Float64) -> Sequence[Solid]:
        def part(name: str, kind: str, size: tuple[float, ...], where: Float64, along: Float64) -> Solid:
            T = pose(where, turn_along(along))
            rgb = SKIN if name in ("hand", "forearm", "head") else (0.25, 0.3, 0.5)
            return Solid(name=f"person_{name}", kind=kind, size=size, track=fixed(T), rgb=rgb)

        slope = away + np.array([0.0, 0.0, 0.45])
        slope /= np.linalg.norm(slope)
        elbow = place + 0.36 * slope
        reaching = [
            part("hand", "capsule", (0.04, 0.05), place + 0.05 * slope, slope),
            part("forearm", "capsule", (0.045, 0.12), place + 0.22 * slope, slope),
            part("upper", "capsule", (0.055, 0.13), elbow + 0.15 * away + 0.08 * np.array([0, 0, 1.0]), away),
        ]
        up = np.array([0.0, 0.0, 1.0])
        trunk = place + 0.80 * away
        still = [
            part("trunk", "capsule", (0.16, 0.40), np.array([trunk[0], trunk[1], 0.05]), up),
            part("head", "ball", (0.11,), np.array([trunk[0], trunk[1], 0.75]), up),
        ]
        offsets = np.array([0.5 * away, 0 * away, 0 * away, 0.5 * away])
        return [*travelling(reaching, times, offsets), *still]

    stage.put(make, wanted(rng), at_start=0.06)


def carried(stage: Stage) -> None:
    """The robot carries a box or can past an object from the start."""
    rng = stage.rng
    half = float(rng.uniform(0.03, 0.08))
    kind, size = ("box", (0.025, 0.03, half)) if rng.random() < 0.5 else ("cylinder", (0.028, half))
    track = fixed(beyond_tip(stage.robot, half - 0.01))
    tip = stage.robot.description.tip
    stage.solids.append(Solid(name="carried", kind=kind, size=size, track=track, rgb=(0.75, 0.6, 0.2), link=tip))
    stage.put(_thing(stage), wanted(rng))


def tool(stage: Stage) -> None:
    """The robot passes an object with a tool at its tip, or a cable, that the URDF lacks."""
    rng, tip = stage.rng, stage.robot.description.tip
    if rng.random() < 0.5:
        size = (float(rng.uniform(0.012, 0.03)), float(rng.uniform(0.03, 0.07)))
        track = fixed(beyond_tip(stage.robot, size[1] - 0.02))
        stage.solids.append(
            Solid(name="tool", kind="cylinder", size=size, track=track, rgb=(0.25, 0.25, 0.28), link=tip)
        )
    else:
        stage.solids += _cable(stage)
    stage.put(_thing(stage), wanted(rng))


def beyond_tip(robot: Robot, further: float) -> Float64:
    """T_tip_thing (4, 4) of an object `further` [m] beyond the tip, with its z axis along the tip's."""
    out = np.array(robot.description.out)
    return pose((robot.description.reach + further) * out, turn_along(out))


def dark(stage: Stage) -> None:
    """An object that returns depth on part of its surface, or none."""
    rng = stage.rng
    share, base = float(rng.uniform(0.4, 1.0)), _thing(stage)
    stage.put(lambda place: [replace(s, lost=share, rgb=(0.05, 0.05, 0.06)) for s in base(place)], wanted(rng))


def wrist(stage: Stage) -> None:
    """A camera on the hand, with one or two stationary cameras; an object near."""
    rng, tip = stage.rng, stage.robot.description.tip
    names = rng.choice(["camera_left", "camera_right"], int(rng.integers(1, 3)), replace=False)
    stage.use_cameras(names.tolist())
    out, side = np.array(stage.robot.description.out), np.array([1.0, 0.0, 0.0])
    T = _look_along(0.07 * side + 0.03 * out, 0.02 * side + 0.5 * out)
    stage.cameras.append(Camera(name="camera_wrist", lens=draw_lens(rng), T_parent_camera=T, link=tip))
    stage.put(_thing(stage), wanted(rng))


def few(stage: Stage) -> None:
    """One, two or four cameras."""
    rng = stage.rng
    names = ["camera_left", "camera_right", "camera_back", "camera_front"]
    count = int(rng.choice([1, 2, 2, 4]))
    stage.use_cameras(sorted(rng.choice(names, count, replace=False).tolist()))
    stage.put(_thing(stage), wanted(rng))


def calibration(stage: Stage) -> None:
    """Logged poses of one camera, or of all, are wrong by 1 to 15 mm and up to half a degree."""
    rng = stage.rng
    stage.put(_thing(stage), wanted(rng))
    wrong = [camera.name for camera in stage.cameras]
    if rng.random() < 0.6:
        wrong = [str(rng.choice(wrong))]
    for name in wrong:
        shift = rng.standard_normal(3)
        shift *= np.exp(rng.uniform(np.log(0.001), np.log(0.015))) / np.linalg.norm(shift)
        turn = turn_rpy(np.deg2rad(rng.uniform(-0.5, 0.5, 3)))
        stage.pose_errors[name] = pose(shift, turn)


def phases(stage: Stage) -> None:
    """Cameras take their images one after the other; an object arrives."""
    rng = stage.rng
    stage.cameras = [replace(camera, phase=float(rng.uniform(0.0, 0.09))) for camera in stage.cameras]
    arrive(stage)


def grasp(stage: Stage) -> None:
    """An object stands in the open hand's way, and later moves with the hand."""
    since = float(stage.rng.uniform(0.3, 0.5))
    times = np.arange(0.0, DURATION_S + 0.01, 0.02)
    offset = beyond_tip(stage.robot, 0.03)
    poses = np.array([stage.tip(max(float(t), since)) @ offset for t in times])
    stage.solids.append(
        Solid(
            name="grasped", kind="ball", size=(0.03,), track=Track(times=times, poses=poses), rgb=(0.2, 0.6, 0.3),
            held=(since, DURATION_S),
        )
    )  # fmt: skip


FAMILIES: dict[str, Family] = {
    "clear": Family(draw=clear),
    "near": Family(draw=near, share=3),
    "contact": Family(draw=contact),
    "shelf": Family(draw=shelf),
    "rods": Family(draw=rods),
    "arrive": Family(draw=arrive, is_at_rest=True, share=2),
    "leave": Family(draw=leave, is_at_rest=True),
    "roll": Family(draw=roll),
    "person": Family(draw=person),
    "carried": Family(draw=carried),
    "grasp": Family(draw=grasp),
    "tool": Family(draw=tool),
    "dark": Family(draw=dark),
    "wrist": Family(draw=wrist),
    "few": Family(draw=few),
    "calibration": Family(draw=calibration),
    "phases": Family(draw=phases, is_at_rest=True),
}
ORDER = tuple(name for name, family in FAMILIES.items() for _ in range(family.share))


def _thing(stage: Stage) -> Make:
    """A thing that reaches above the place it is put at."""
    return draw_thing(stage.rng, "target", height=float(stage.rng.uniform(0.02, 0.12)))


def _board(name: str, size: tuple[float, float, float], place: tuple[float, float, float]) -> Solid:
    return Solid(name=name, kind="box", size=size, track=fixed(pose(place)), rgb=(0.66, 0.55, 0.38))


def _heading(rng: np.random.Generator) -> Float64:
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _look_along(eye: Float64, target: Float64) -> Float64:
    """T_link_camera (4, 4) at `eye` (3,), looking at `target` (3,); its x axis need not be level."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    return pose(eye, np.column_stack([x, np.cross(z, x), z]))


def _cable(stage: Stage) -> list[Solid]:
    """A cable of 8 mm that sags beside a long link, in eight capsules."""
    robot: Robot = stage.robot
    link = max(
        (k for k in robot.visual if k not in robot.fixed_links and robot.visual[k]),
        key=lambda k: float(np.ptp(np.concatenate([p.vertices for p in robot.visual[k]]), axis=0).max()),
    )
    points = np.concatenate([piece.vertices for piece in robot.visual[link]])
    axis = int(np.argmax(np.ptp(points, axis=0)))
    across = (axis + 1) % 3
    s = np.linspace(0.1, 0.9, 9)
    path = np.tile(points.mean(axis=0), (9, 1))
    path[:, axis] = points[:, axis].min() + s * np.ptp(points[:, axis])
    path[:, across] = points[:, across].max() + 0.004 + 0.03 * np.sin(np.pi * (s - 0.1) / 0.8)
    out = []
    for number, (a, b) in enumerate(pairwise(path)):
        T = pose((a + b) / 2, turn_along(b - a))
        size = (0.004, float(np.linalg.norm(b - a)) / 2)
        out.append(
            Solid(name=f"cable{number}", kind="capsule", size=size, track=fixed(T), rgb=(0.1, 0.1, 0.1), link=link)
        )
    return out
