"""Pairs of links to check for self-collision, and reasons to omit pairs (MoveIt's SRDF)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from defusedxml import ElementTree

from splatctrl_cli.config.fixed import NEVER_MARGIN
from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.formats.unpacking import read_text
from splatctrl_cli.records import Float64, Index
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.urdf import UrdfFile


def read_srdf(path: Path, urdf: UrdfFile) -> tuple[dict[frozenset[str], str], list[tuple[str, str]]]:
    """Reasons ("Adjacent", "Never", ...) by ``disable_collisions`` pair in `urdf`, and pairs with an unknown link.

    Raises InputError for a file that is no SRDF, a pair without links, or no pair within the URDF.
    """
    # ValueError: no text, or what defusedxml forbids
    with refuse_faults(
        f"{path}: expected an SRDF, got broken XML", ElementTree.ParseError, ValueError, remedy="give an SRDF file"
    ):
        root = ElementTree.fromstring(read_text(path, "give the robot's SRDF file"))
    got = "a URDF" if root.tag == "robot" else f"<{root.tag}>"
    refuse_if(
        root.tag != "robot" or root.find("link") is not None or root.find("joint") is not None,
        f"{path}: expected an SRDF, got {got}",
        remedy="give the file with <disable_collisions>",
    )
    known: dict[frozenset[str], str] = {}
    foreign: list[tuple[str, str]] = []
    for element in root.findall("disable_collisions"):
        first, second = element.get("link1"), element.get("link2")
        if not first or not second:
            raise InputError(f"{path}: disable_collisions: expected link1 and link2, got {dict(element.attrib)}")
        if {first, second} <= set(urdf.links):
            known[frozenset((first, second))] = element.get("reason") or "no reason given"
        else:
            foreign.append((first, second))
    refuse_if(
        not known,
        f"{path}: expected disable_collisions between links of the URDF, got "
        + (f"{len(foreign)} of links that {urdf.path.name} lacks" if foreign else "none"),
        remedy="give the SRDF of the same robot, or none",
    )
    return known, foreign


CHUNK = 200  # postures at a time


@dataclass(frozen=True, kw_only=True)
class LinkPair:
    """Two links with spheres, and their spheres' gap over sampled postures.

    left_out: reason to omit it, None if checked. least_gap, largest_gap [m] (nan: not sampled); hit_share: of
    postures in contact.
    """

    links: tuple[str, str]
    left_out: str | None
    num_sphere_pairs: int
    least_gap: float
    largest_gap: float
    hit_share: float


@dataclass(frozen=True, kw_only=True)
class SelfCollisionPairs:
    """Pairs (P, 2) of spheres to check, and all pairs of links with spheres."""

    pairs: Index
    link_pairs: tuple[LinkPair, ...]
    num_postures: int

    @property
    def left_out(self) -> tuple[LinkPair, ...]:
        return tuple(pair for pair in self.link_pairs if pair.left_out is not None)


def self_collision_pairs(
    model: RobotModel,
    disabled: Mapping[frozenset[str], str] | None = None,
    *,
    num_postures: int = 2000,
    seed: int = 0,
    drop_never: bool = False,
) -> SelfCollisionPairs:
    """Pairs of spheres that may collide.

    Omitted are links of one rigid body or joined by one joint, and an SRDF's `disabled` pairs. Without `disabled`,
    links in contact in all `num_postures` uniform postures are omitted, too; with `drop_never`, also links never
    nearer than NEVER_MARGIN.
    """
    links = tuple(dict.fromkeys(model.sphere_set.links))
    owner = np.array([links.index(link) for link in model.sphere_set.links], dtype=np.int64)
    known = {pair: f"SRDF: {reason}" for pair, reason in (disabled or {}).items()} | joined_links(model, links)
    num_postures = 0 if disabled else num_postures
    a, b = np.triu_indices(len(links), k=1)
    gaps = _gaps(model, owner, np.stack([a, b], axis=1), num_postures, seed)
    pairs = [
        LinkPair(
            links=(links[i], links[j]),
            left_out=known.get(frozenset((links[i], links[j]))) or _sampled_reason(column, drop_never),
            num_sphere_pairs=int((owner == i).sum() * (owner == j).sum()),
            least_gap=float(column.min()) if len(column) else np.nan,
            largest_gap=float(column.max()) if len(column) else np.nan,
            hit_share=float(np.mean(column <= 0)) if len(column) else np.nan,
        )
        for i, j, column in zip(a, b, gaps.T, strict=True)
    ]
    keep = np.zeros((len(links), len(links)), dtype=bool)
    keep[a, b] = keep[b, a] = [pair.left_out is None for pair in pairs]
    first, second = np.triu_indices(len(owner), k=1)
    is_kept = keep[owner[first], owner[second]]
    return SelfCollisionPairs(
        pairs=np.stack([first[is_kept], second[is_kept]], axis=1).astype(np.int64),
        link_pairs=tuple(pairs),
        num_postures=num_postures,
    )


def drop_disabled(model: RobotModel, disabled: Collection[frozenset[str]]) -> Index:
    """`self_pairs` (P, 2) without links that an SRDF has `disabled`."""
    links, pairs = model.sphere_set.links, model.self_pairs()
    return np.asarray(
        pairs[np.array([frozenset((links[a], links[b])) not in disabled for a, b in pairs], dtype=bool)]
    )


def fixtures(model: RobotModel) -> set[str]:
    """Links that stand still and carry no moving joint: table, post, base cover."""
    bodies = model.urdf.rigid_bodies(model.joint_names)
    moving = [joint for joint in model.urdf.joints if joint.name in model.joint_names]
    led = {joint.child for joint in moving}
    return {link for link, (leader, _) in bodies.items() if leader not in led} - {joint.parent for joint in moving}


def joined_links(model: RobotModel, links: Sequence[str]) -> dict[frozenset[str], str]:
    """Inseparable pairs of links, and why: one rigid body, or one joint.

    A joint to a fixture does not count.
    """
    standing = fixtures(model)
    bodies = model.urdf.rigid_bodies(model.joint_names)
    leader = {link: bodies[link][0] for link in links}
    parent = {joint.child: bodies[joint.parent][0] for joint in model.urdf.joints}
    reasons = {}
    for one, other in combinations(links, 2):
        if leader[one] == leader[other]:
            reasons[frozenset((one, other))] = "one rigid body"
        elif one in standing or other in standing:
            continue
        elif leader[one] == parent.get(leader[other]) or leader[other] == parent.get(leader[one]):
            reasons[frozenset((one, other))] = "adjacent"
    return reasons


def _sampled_reason(gaps: Float64, drop_never: bool) -> str | None:
    if not len(gaps):
        return None
    if (gaps <= 0).all():
        return f"touch in all {len(gaps)} postures"
    if drop_never and gaps.min() > NEVER_MARGIN:
        return f"no nearer than {1e3 * gaps.min():.0f} mm in {len(gaps)} postures"
    return None


def random_postures(model: RobotModel, num_postures: int, seed: int) -> Float64:
    """Uniform postures (T, J) within the limits; an unlimited joint turns once."""
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    lower, upper = np.where(limited, model.lower, -np.pi), np.where(limited, model.upper, np.pi)
    return np.random.default_rng(seed).uniform(lower, upper, (num_postures, model.num_joints))


def _gaps(model: RobotModel, owner: Index, pairs: Index, num_postures: int, seed: int) -> Float64:
    postures = random_postures(model, num_postures, seed)
    radii = model.sphere_set.radii
    members = [np.flatnonzero(owner == link) for link in range(int(owner.max(initial=-1)) + 1)]
    gaps = np.empty((num_postures, len(pairs)))
    for start in range(0, num_postures, CHUNK):
        centers = model.sphere_centers_batch(postures[start : start + CHUNK])
        for column, (i, j) in enumerate(pairs):
            away = centers[:, members[i], None] - centers[:, None, members[j]]
            gap = np.linalg.norm(away, axis=3) - radii[members[i], None] - radii[None, members[j]]
            gaps[start : start + CHUNK, column] = gap.min(axis=(1, 2))
    return gaps
