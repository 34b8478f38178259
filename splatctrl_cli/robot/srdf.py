"""Pairs of links that an SRDF (MoveIt's semantic description) takes out of self-collision checks."""

from dataclasses import dataclass
from pathlib import Path

from defusedxml import ElementTree

from splatctrl_cli.errors import InputError
from splatctrl_cli.robot.urdf import UrdfFile


@dataclass(frozen=True, kw_only=True)
class DisabledPair:
    """Two links whose collisions are not looked for, and the SRDF's reason ("Adjacent", "Never", ...)."""

    links: tuple[str, str]
    reason: str


def read_srdf(path: Path, urdf: UrdfFile) -> tuple[tuple[DisabledPair, ...], tuple[DisabledPair, ...]]:
    """The pairs of ``disable_collisions``: those between links of `urdf`, and those that name a link it lacks.

    Raises InputError for a file that is missing or no SRDF, a pair without links, no pair at all, and where no pair
    is between links of the URDF.
    """
    try:
        root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", remedy="give the robot's SRDF file") from None
    except (ElementTree.ParseError, ValueError) as error:  # ValueError: no text, or what defusedxml forbids
        raise InputError(f"{path}: expected an SRDF, got broken XML: {error}", remedy="give an SRDF file") from None
    if root.tag != "robot" or root.find("link") is not None or root.find("joint") is not None:
        got = "a URDF" if root.tag == "robot" else f"<{root.tag}>"
        raise InputError(f"{path}: expected an SRDF, got {got}", remedy="give the file with <disable_collisions>")
    pairs = []
    for element in root.findall("disable_collisions"):
        first, second = element.get("link1"), element.get("link2")
        if not first or not second:
            raise InputError(f"{path}: disable_collisions: expected link1 and link2, got {dict(element.attrib)}")
        pairs.append(DisabledPair(links=(first, second), reason=element.get("reason") or "no reason given"))
    known = tuple(pair for pair in pairs if set(pair.links) <= set(urdf.links))
    if not known:
        got = f"{len(pairs)} of links that {urdf.path.name} lacks" if pairs else "none"
        raise InputError(
            f"{path}: expected disable_collisions between links of the URDF, got {got}",
            remedy="give the SRDF of the same robot, or none",
        )
    return known, tuple(pair for pair in pairs if pair not in known)
