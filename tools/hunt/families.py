"""The families of the hunt: each one's target near the arm, and its faults."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Float64
from splatctrl_cli.simulate.arm import Capsule
from splatctrl_cli.simulate.primitives import Primitive
from tools.hunt.faults import NUM_JOINTS, Fault
from tools.hunt.world import NUM_FRAMES, Made, Make, during, floating, moving, shifted

CAMERAS = ("cam0", "cam1", "cam2")
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Draft:
    """One family's draw: the kind of the fault, its strength in a unit of the kind, and the target.

    second: time [s] at which the target is near the arm, None for any. cameras: recorded cameras. touches_first: the
    target may be at the arm from the start. people: names in masks. only_audit: never driven. only_closed: always
    driven. distance: of the cameras, as a share of the usual. has_wrist: a further camera is on the hand. settings:
    of the configuration, by key. turn: of the motion, as a share of the usual. towards: direction from which the
    target nears the arm: the side that cameras do not see (`behind`), the x axis, or any. from_link: share of the
    arm, from its base, that the target does not near. box_gap [m]: between the workspace's end and the target.
    max_map_age [s]: allowed by the user.
    """

    kind: str
    strength: float
    make: Make
    fault: Fault = field(default_factory=Fault)
    second: float | None = None
    cameras: tuple[str, ...] = CAMERAS
    zoom: float = 1.0
    touches_first: bool = False
    tool: Capsule | None = None
    carried: tuple[float, float] | None = None
    people: frozenset[str] = frozenset()
    only_audit: bool = False
    only_closed: bool = False
    distance: float = 1.0
    has_wrist: bool = False
    settings: tuple[tuple[str, float], ...] = ()
    turn: float = 1.0
    towards: str = ""
    from_link: float = 0.5
    box_gap: float | None = None
    max_map_age: float | None = None


def target(rng: np.random.Generator, size: float = 1.0) -> Make:
    """A post or box on the table, or a hanging ball or box; `size` scales its width."""
    kind = ("post", "box", "ball", "crate")[int(rng.integers(4))]
    width = size * rng.uniform(0.04, 0.10)
    above = float(rng.uniform(0.02, 0.12))
    solid = floating("target", "sphere", (float(width),), np.zeros(3), rng)
    depth = float(width * rng.uniform(0.7, 1.5))

    def make(place: Float64) -> Made:
        height = max(float(place[2]) + above, 0.08)
        if kind == "post":
            return (_standing(solid, "cylinder", (float(width) / 2 + 0.01, height), place),)
        if kind == "box":
            return (_standing(solid, "box", (float(width), depth, height), place),)
        if kind == "crate":
            return (_resized(solid, "box", (float(width), depth, float(width)), place),)
        return (shifted(solid, place),)

    return make


def benign(rng: np.random.Generator) -> Draft:
    """Nothing is wrong; things may well be in the way."""
    return Draft(kind="none", strength=0.0, make=target(rng))


def budget(rng: np.random.Generator) -> Draft:
    """Fewer splats than the surfaces need."""
    splats = int(np.exp(rng.uniform(np.log(60), np.log(2000))))
    return Draft(kind="splats", strength=splats, make=target(rng), fault=Fault(max_splats=splats))


def thin(rng: np.random.Generator) -> Draft:
    """Rods and plates a few millimetres across: at or below a pixel and a voxel."""
    kind = ("rod", "bar", "plate")[int(rng.integers(3))]
    across = float(np.exp(rng.uniform(np.log(0.003), np.log(0.03))))
    tilt = UP + rng.uniform(-0.4, 0.4, 3) if kind == "rod" else np.array([*rng.standard_normal(2), 0.2])
    length = float(rng.uniform(0.25, 0.6))
    size = (across, length, length * float(rng.uniform(0.4, 1.0))) if kind == "plate" else (across / 2, length)
    form = "box" if kind == "plate" else "cylinder"
    solid = floating("target", form, size, np.zeros(3), rng, None if kind == "plate" else tilt)
    return Draft(kind=kind, strength=1e3 * across, make=lambda place: (shifted(solid, place),))


def touch(rng: np.random.Generator) -> Draft:
    """Objects at the arm from the start, in its hand, or just beside its path."""
    kind = ("resting", "carried", "close")[int(rng.integers(3))]
    if kind == "carried":
        length = float(rng.uniform(0.06, 0.25))
        radius = float(rng.uniform(0.015, 0.04))
        solid = floating("target", "capsule", (radius, length), np.zeros(3), rng)
        return Draft(
            kind=kind, strength=length, make=lambda place: (solid,), carried=(radius, length), only_audit=True
        )
    if kind == "resting":
        return Draft(
            kind=kind, strength=0.0, make=target(rng), second=0.05, touches_first=True, only_audit=rng.random() < 0.6
        )
    return Draft(kind=kind, strength=0.0, make=target(rng, 1.6))


def visit(rng: np.random.Generator) -> Draft:
    """Things that appear, leave, or move at up to 1 m/s."""
    kind = ("appears", "leaves", "arrives", "crosses")[int(rng.integers(4))]
    at = float(rng.uniform(0.9, 2.6))
    base, speed = target(rng), float(rng.uniform(0.1, 1.0))
    heading = rng.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    far, stays = 0.7, float(rng.uniform(0.3, 0.9))

    def make(place: Float64) -> Made:
        (solid,) = base(place)
        if kind == "appears":
            return (during(solid, at - 0.3, None),)
        if kind == "leaves":
            return (during(solid, None, at + 0.3),)
        seconds = [at - far / speed, at] if kind == "arrives" else [at - far / speed, at, at + far / speed]
        offsets = (
            [-far * direction, np.zeros(3)] if kind == "arrives" else [-far * direction, 0 * UP, far * direction]
        )
        if kind == "crosses" and stays > 0.6:  # it stops for a while
            seconds, offsets = (
                [*seconds[:2], at + stays, at + stays + far / speed],
                [*offsets[:2], 0 * UP, offsets[2]],
            )
        return (moving(solid, seconds, np.array(offsets)),)

    return Draft(kind=kind, strength=speed, make=make, second=at, touches_first=True)


def occlusion(rng: np.random.Generator) -> Draft:
    """One or two cameras; the arm may hide the target, which is there from the start or appears."""
    cameras = tuple(sorted(rng.choice(CAMERAS, size=1 if rng.random() < 0.7 else 2, replace=False).tolist()))
    base, appears = target(rng, 0.8), rng.random() < 0.5
    since = float(rng.uniform(0.6, 1.6)) if appears else None
    return Draft(
        kind="appears" if appears else "stands",
        strength=len(cameras),
        make=lambda place: (during(base(place)[0], since, None),),
        cameras=cameras,
    )


def holes(rng: np.random.Generator) -> Draft:
    """Missing depth: dark or shiny targets, short range, wide edges."""
    kind = ("dark", "shiny", "far", "edges")[int(rng.integers(4))]
    make = target(rng)
    if kind in ("dark", "shiny"):
        share = 1.0 if rng.random() < 0.4 else float(rng.uniform(0.3, 1.0))
        return Draft(kind=kind, strength=share, make=make, fault=Fault(dark=share, speckle=kind == "shiny"))
    if kind == "far":
        reach = float(rng.uniform(0.7, 1.3))
        return Draft(kind=kind, strength=reach, make=make, fault=Fault(max_range=reach))
    edge = float(np.exp(rng.uniform(np.log(0.012), np.log(0.06))))
    return Draft(kind=kind, strength=edge, make=make, fault=Fault(edge=edge, edge_share=1.0))


def depth(rng: np.random.Generator) -> Draft:
    """Depth of one camera or of all is scaled or shifted; sometimes there is only one camera."""
    is_scale, share = rng.random() < 0.5, rng.random()
    recorded = (CAMERAS[int(rng.integers(3))],) if share > 0.7 else CAMERAS
    spoiled = recorded if share > 0.4 else (CAMERAS[int(rng.integers(3))],)
    sign = rng.choice([-1, 1])
    if is_scale:
        error = float(sign * np.exp(rng.uniform(np.log(0.003), np.log(0.10))))
        fault = Fault(depth_scale=dict.fromkeys(spoiled, 1 + error))
    else:
        error = float(sign * np.exp(rng.uniform(np.log(0.003), np.log(0.08))))
        fault = Fault(depth_bias=dict.fromkeys(spoiled, error))
    kind = f"{'scale' if is_scale else 'bias'} of {len(spoiled)} of {len(recorded)}"
    return Draft(kind=kind, strength=error, make=target(rng), fault=fault, cameras=recorded)


def pose(rng: np.random.Generator) -> Draft:
    """Logged poses of one camera, or of all alike, are wrong by 1 mm to 5 cm and up to 2 degrees."""
    share = rng.random()
    recorded = (CAMERAS[int(rng.integers(3))],) if share > 0.75 else CAMERAS
    spoiled = recorded if share > 0.5 else (CAMERAS[int(rng.integers(3))],)
    size = float(np.exp(rng.uniform(np.log(0.001), np.log(0.05))))
    shift, turn = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    angle = np.deg2rad(2.0) * size / 0.05 * rng.uniform(0, 1) if len(spoiled) == 1 else 0.0
    error = np.concatenate([size * shift, angle * turn])
    kind = f"{len(spoiled)} of {len(recorded)}"
    fault = Fault(pose=dict.fromkeys(spoiled, error))
    return Draft(kind=kind, strength=size, make=target(rng), fault=fault, cameras=recorded)


def clock(rng: np.random.Generator) -> Draft:
    """Stamps of all images, or of one camera's, are early or late by up to half a second; often things move."""
    late = float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.02), np.log(0.5))))
    spoiled = CAMERAS if rng.random() < 0.7 else (CAMERAS[int(rng.integers(3))],)
    fault = Fault(clock=dict.fromkeys(spoiled, late))
    moves = visit(rng) if rng.random() < 0.6 else benign(rng)
    return Draft(
        kind=f"{len(spoiled)} of 3, {moves.kind}",
        strength=late,
        make=moves.make,
        fault=fault,
        second=moves.second,
        touches_first=moves.touches_first,
    )


def frames(rng: np.random.Generator) -> Draft:
    """Images or joint states that are missing or late, or images that see nothing."""
    kind = ("blind", "lost", "thinned", "latency", "states")[int(rng.integers(5))]
    first = int(rng.integers(2, NUM_FRAMES - 4))
    last = first + int(rng.integers(2, NUM_FRAMES - first))
    spell = frozenset((camera, index) for camera in CAMERAS for index in range(first, last))
    base = target(rng)
    since = first / 5.0 + float(rng.uniform(-0.3, 0.3))

    def make(place: Float64) -> Made:
        return (during(base(place)[0], since, None),)

    if kind == "thinned":
        share = float(rng.uniform(0.2, 0.8))
        lost = frozenset((c, i) for c in CAMERAS for i in range(1, NUM_FRAMES) if rng.random() < share)
        return Draft(kind=kind, strength=share, make=make, fault=Fault(lost=lost))
    if kind == "latency":
        late = float(rng.uniform(0.1, 1.2))
        return Draft(kind=kind, strength=late, make=make, fault=Fault(latency=late))
    if kind == "states":
        start = float(rng.uniform(0.6, 2.2))
        length = float(rng.uniform(0.1, 0.9))
        fault = Fault(lost_states=(start, start + length))
        middle = start + length / 2
        return Draft(kind=kind, strength=length, make=base, fault=fault, second=middle, only_audit=True)
    fault = Fault(blind=spell) if kind == "blind" else Fault(lost=spell)
    return Draft(kind=kind, strength=(last - first) / 5.0, make=make, fault=fault)


def robot(rng: np.random.Generator) -> Draft:
    """A model of few or small spheres, with a wrong link or without a tool, or wrongly logged joints."""
    kind = ("few", "small", "longer", "tool", "swapped", "degrees", "offset")[int(rng.integers(7))]
    make = target(rng)
    if kind == "few":
        share = float(rng.uniform(0.2, 0.9))
        return Draft(kind=kind, strength=share, make=make, fault=Fault(spheres_kept=share))
    if kind == "small":
        shrunk = float(np.exp(rng.uniform(np.log(0.003), np.log(0.04))))
        return Draft(kind=kind, strength=shrunk, make=make, fault=Fault(spheres_shrunk=shrunk))
    if kind == "longer":
        by = float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.01), np.log(0.10))))
        return Draft(kind=kind, strength=by, make=make, fault=Fault(longer=(int(rng.choice([2, 4])), by)))
    if kind == "tool":
        length = float(rng.uniform(0.05, 0.20))
        tool = Capsule(start=(0.0, 0.0, 0.08), end=(0.0, 0.0, 0.08 + length), radius=float(rng.uniform(0.012, 0.03)))
        return Draft(kind=kind, strength=length, make=make, tool=tool)
    if kind == "swapped":
        a, b = (int(v) for v in rng.choice(NUM_JOINTS, size=2, replace=False))
        order = list(range(NUM_JOINTS))
        order[a], order[b] = b, a
        return Draft(kind=kind, strength=10 * (a + 1) + b + 1, make=make, fault=Fault(order=tuple(order)))
    if kind == "degrees":
        return Draft(kind=kind, strength=1.0, make=make, fault=Fault(in_degrees=True))
    offset = [0.0] * NUM_JOINTS
    by = float(rng.choice([-1, 1]) * np.deg2rad(np.exp(rng.uniform(np.log(0.5), np.log(10)))))
    offset[int(rng.integers(0, 6))] = by
    return Draft(kind=kind, strength=by, make=make, fault=Fault(offset=tuple(offset)))


def unknown(rng: np.random.Generator) -> Draft:
    """One or two cameras of long focal length that look elsewhere; the path leads through unseen space."""
    cameras = tuple(sorted(rng.choice(CAMERAS, size=1 if rng.random() < 0.6 else 2, replace=False).tolist()))
    zoom = float(rng.uniform(1.4, 3.0))
    return Draft(kind=f"{len(cameras)} cameras", strength=zoom, make=target(rng), cameras=cameras, zoom=zoom)


def people(rng: np.random.Generator) -> Draft:
    """A person's arm that reaches in and stays a while, with or without masks."""
    has_masks, at, stays = rng.random() < 0.6, float(rng.uniform(0.8, 2.4)), float(rng.uniform(0.2, 0.8))
    speed = float(rng.uniform(0.2, 1.0))
    heading = rng.uniform(-1.2, 1.2)
    toward = -np.array([np.cos(heading), np.sin(heading), float(rng.uniform(0.1, 0.6))])
    toward /= np.linalg.norm(toward)
    hand = floating("human.hand", "capsule", (0.038, 0.09), np.zeros(3), rng, toward)
    forearm = floating("human.forearm", "capsule", (0.042, 0.28), np.zeros(3), rng, toward)
    far, leaves = 0.6, rng.random() < 0.6

    def make(place: Float64) -> Made:
        seconds = [at - far / speed, at] + ([at + stays, at + stays + far / speed] if leaves else [])
        offsets = np.array([-far * toward, 0 * UP] + ([0 * UP, -far * toward] if leaves else []))
        parts = (shifted(hand, place), shifted(forearm, place - 0.20 * toward))
        return tuple(moving(part, seconds, offsets) for part in parts)

    names = frozenset({"human.hand", "human.forearm"}) if has_masks else frozenset()
    return Draft(
        kind="masks" if has_masks else "no masks", strength=speed, make=make, second=at, people=names,
        touches_first=True,
    )  # fmt: skip


def behind(rng: np.random.Generator) -> Draft:
    """Driven past things of which one or two cameras see a side."""
    draft = occlusion(rng)
    return replace(draft, only_closed=True)


def far(rng: np.random.Generator) -> Draft:
    """Cameras up to three times as far away, with lenses as long or a little wider: depth errs by up to 14 mm."""
    distance = float(rng.uniform(1.5, 2.8))
    fewer = tuple(sorted(rng.choice(CAMERAS, size=int(rng.integers(1, 4)), replace=False).tolist()))
    zoom = distance * float(rng.uniform(0.6, 1.0))
    kind = f"{len(fewer)} cameras"
    return Draft(kind=kind, strength=distance, make=target(rng), cameras=fewer, distance=distance, zoom=zoom)


def wrist(rng: np.random.Generator) -> Draft:
    """A camera on the hand, alone or beside one that stands."""
    fixed = tuple(rng.choice(CAMERAS, size=int(rng.random() < 0.6), replace=False).tolist())
    draft = visit(rng) if rng.random() < 0.3 else benign(rng)
    return replace(draft, kind=f"beside {len(fixed)}, {draft.kind}", cameras=fixed, has_wrist=True)


def settings(rng: np.random.Generator) -> Draft:
    """One or two settings that make the map coarser, slower or blinder, as a user may choose them."""
    names = rng.choice(list(SETTINGS), size=int(rng.integers(1, 3)), replace=False).tolist()
    chosen = tuple((name, float(np.exp(rng.uniform(*np.log(SETTINGS[name]))))) for name in names)
    draft = (benign, visit, thin, touch)[int(rng.integers(4))](rng)
    return replace(draft, kind=" ".join(names), strength=chosen[0][1], settings=chosen)


def frozen(rng: np.random.Generator) -> Draft:
    """Each camera's last image, or only its depth, repeats with new stamps while an object nears the arm."""
    first = int(rng.integers(3, NUM_FRAMES - 5))
    base, repeats_color = target(rng), rng.random() < 0.5
    since = first / 5.0 + float(rng.uniform(0.0, 0.3))

    def make(place: Float64) -> Made:
        return (during(base(place)[0], since, None),)

    fault = Fault(repeated=first, repeats_color=repeats_color)
    kind = "image" if repeats_color else "depth"
    return Draft(kind=kind, strength=first / 5.0, make=make, fault=fault, turn=_turn(rng), only_audit=True)


def too_far(rng: np.random.Generator) -> Draft:
    """A shiny target is measured far behind its place, or with the largest depth that the format has."""
    kind = ("shiny", "instead")[int(rng.integers(2))]
    if kind == "shiny":
        beyond = float(rng.uniform(0.15, 0.7))
        return Draft(kind=kind, strength=beyond, make=target(rng), fault=Fault(beyond=beyond))
    instead = float(rng.choice([4.0, 5.0, 65.535]))
    return Draft(kind=kind, strength=instead, make=target(rng), fault=Fault(instead=instead))


def small(rng: np.random.Generator) -> Draft:
    """A motion of a few centimetres, one or two cameras, and a ball behind the arm that none sees."""
    cameras = tuple(sorted(rng.choice(CAMERAS, size=1 + int(rng.random() < 0.4), replace=False).tolist()))
    radius = float(rng.uniform(0.02, 0.04))
    solid = floating("target", "sphere", (radius,), np.zeros(3), rng)
    return Draft(
        kind=f"{len(cameras)} cameras", strength=2e3 * radius, make=lambda place: (shifted(solid, place),),
        cameras=cameras, turn=float(rng.uniform(0.03, 0.15)), towards="behind",
        from_link=float(rng.choice([0.25, 0.5])), touches_first=True,
    )  # fmt: skip


def box(rng: np.random.Generator) -> Draft:
    """The workspace ends just before a plate that all cameras show."""
    size = (float(rng.uniform(0.01, 0.03)), float(rng.uniform(0.25, 0.5)), float(rng.uniform(0.25, 0.5)))
    solid = floating("target", "box", size, np.zeros(3), rng, UP)

    def make(place: Float64) -> Made:
        return (replace(solid, T_world_shape=pose_at(place)),)

    gap = float(rng.uniform(-0.01, 0.03))
    return Draft(kind="plate", strength=1e3 * gap, make=make, towards="x", box_gap=gap, only_audit=True)


def waiver(rng: np.random.Generator) -> Draft:
    """Cameras that give no depth for long, and a user who allows a map of any age."""
    draft = frames(rng)
    while draft.kind != "blind":
        draft = frames(rng)
    return replace(draft, max_map_age=100.0, only_audit=True)


def dark(rng: np.random.Generator) -> Draft:
    """A target next to any part of the arm that returns no depth to any camera; the arm may rest."""
    cameras = CAMERAS if rng.random() < 0.5 else tuple(sorted(rng.choice(CAMERAS, size=2, replace=False).tolist()))
    return Draft(
        kind=f"{len(cameras)} cameras", strength=1.0, make=target(rng), fault=Fault(dark=1.0), cameras=cameras,
        turn=_turn(rng), from_link=0.25, touches_first=True,
    )  # fmt: skip


def still(rng: np.random.Generator) -> Draft:
    """Nothing is wrong, and the arm moves by centimetres."""
    return replace(benign(rng), turn=float(rng.uniform(0.03, 0.15)), touches_first=True)


def _turn(rng: np.random.Generator) -> float:
    """The usual motion, or a small one."""
    return 1.0 if rng.random() < 0.5 else float(rng.uniform(0.03, 0.2))


SETTINGS = {  # integers are rounded
    "occupancy.self_mask_tolerance": (0.006, 0.06),
    "occupancy.depth_error": (0.003, 0.03),
    "occupancy.min_range": (0.3, 1.1),
    "occupancy.max_range": (0.7, 1.5),
    "occupancy.see_through": (0.0005, 0.01),
    "occupancy.voxel": (0.02, 0.05),
    "occupancy.uncertain_patience": (0.3, 2.0),
    "scene.min_opacity": (0.15, 0.6),
    "scene.lambda_reg": (0.02, 2.0),
    "scene.max_gap": (0.03, 1.0),
    "scene.max_radius": (0.003, 0.019),
    "scene.first_iterations": (0.3, 10.0),
    "scene.lr_center": (0.001, 0.1),
    "scene.lr_log_radius": (0.05, 1.0),
    "scene.lr_logit_opacity": (0.2, 5.0),
    "scene.noise": (5e6, 5e8),
    "scene.contact_radius": (0.001, 0.005),
    "scene.snapshot_every": (2.0, 5.0),
    "scene.hole_opacity": (0.01, 0.2),
    "scene.radius_per_edge": (0.05, 0.3),
    "scene.max_depth_error": (0.1, 10.0),
    "scene.lambda_depth": (0.01, 0.3),
    "scene.fill": (0.05, 0.5),
}

FAMILIES: dict[str, Callable[[np.random.Generator], Draft]] = {
    "benign": benign,
    "budget": budget,
    "thin": thin,
    "touch": touch,
    "visit": visit,
    "occlusion": occlusion,
    "holes": holes,
    "depth": depth,
    "pose": pose,
    "clock": clock,
    "frames": frames,
    "robot": robot,
    "unknown": unknown,
    "people": people,
    "behind": behind,
    "far": far,
    "wrist": wrist,
    "settings": settings,
    "frozen": frozen,
    "too far": too_far,
    "small": small,
    "box": box,
    "waiver": waiver,
    "dark": dark,
    "still": still,
}
ORDER = (*FAMILIES, "benign")  # by turns; benign twice, as its share of green is a gate
LATER = ("behind", "far", "wrist", "settings")  # not in the campaigns of seeds below 100
NEWEST = ("frozen", "too far", "small", "box", "waiver", "dark", "still")  # not in those of seeds below 500


def _standing(solid: Primitive, kind: str, size: tuple[float, ...], place: Float64) -> Primitive:
    return _resized(solid, kind, size, np.array([place[0], place[1], size[-1] / 2]))


def _resized(solid: Primitive, kind: str, size: tuple[float, ...], place: Float64) -> Primitive:
    return Primitive(
        name=solid.name,
        kind=kind,
        size=size,
        T_world_shape=shifted(solid, place).T_world_shape,
        texture=solid.texture,
    )
