"""What ``splatctrl robot`` prints: coverage by link, self-collision pairs, joints with their limits."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from splatctrl_cli.cli.common import table
from splatctrl_cli.evaluate.gates import gate_reasons
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, noted, verdict_of
from splatctrl_cli.robot.coverage import CoverageReport, LinkCoverage
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import LinkPair, SelfCollisionPairs

METRICS = (
    "max_deficit",
    "uncovered_share",
    "max_protrusion",
    "num_spheres",
    "num_bare_links",
    "num_open_links",
    "num_stray_spheres",
)


def metrics_of(report: "CoverageReport") -> dict[str, float | None]:
    """The figures that ``--require`` may name; lengths in metres, None where no figure bounds it."""
    return {
        "max_deficit": report.max_deficit,
        "uncovered_share": report.uncovered_share,
        "max_protrusion": report.max_protrusion,
        "num_spheres": report.num_spheres,
        "num_bare_links": len(report.bare_links),
        "num_open_links": len(report.open_links),
        "num_stray_spheres": report.stray_spheres,
    }


def coverage_verdict(report: "CoverageReport", command: str, require: Sequence[str]) -> "Verdict":
    """The verdict on a set of spheres: what they leave uncovered, links without any, and each ``--require``."""
    num, bare = len(report.links), ", ".join(report.bare_links)
    counts = dict.fromkeys(METRICS, num) | dict.fromkeys(("max_protrusion", "num_stray_spheres"), report.num_spheres)
    covered = Reason(
        criterion="coverage",
        outcome=Outcome.PASSED,
        sentence=_summary(report),
        value=report.max_deficit,
        unit="m",
        count=num,
    )
    bare_links = [noted("coverage", f"no sphere stands for {bare}: nothing is said of these links")] if bare else []
    return verdict_of(
        command,
        [covered, *bare_links, *gate_reasons(require, metrics_of(report), counts)],
        scope=f"{report.num_spheres} spheres on {num} links",
        counts=counts,
    )


def coverage_json(report: "CoverageReport") -> dict[str, Any]:
    """Metrics and a row per link, for ``--json``."""
    return {"metrics": metrics_of(report), "links": [_link_json(link) for link in report.links]}


def coverage_lines(report: "CoverageReport") -> list[str]:
    """The table by link and, below it, what it means."""
    header = ("link", "spheres", "area cm2", "uncovered %", "deficit mm", "at x, y, z mm", "sticks out mm")
    lines = table(header, [_row(link) for link in report.links])
    lines += ["", _summary(report)]
    if report.bare_links:
        lines.append(f"no sphere stands for {', '.join(report.bare_links)}: nothing is said of these links")
    if report.open_links:
        lines.append(
            f"not closed: {', '.join(report.open_links)}: what is said of the surface holds; an inside there is not, "
            "so spheres stick out of its convex hull"
        )
    if report.stray_spheres:
        lines.append(f"{report.stray_spheres} spheres are on links without collision geometry")
    return lines


def pairs_json(found: "SelfCollisionPairs") -> dict[str, Any]:
    """Counts and a row per pair of links, for ``--json``."""
    rows = [
        {
            "links": list(pair.links),
            "left_out": pair.left_out,
            "sphere_pairs": pair.num_sphere_pairs,
            "least_gap": _known(pair.least_gap),
            "largest_gap": _known(pair.largest_gap),
            "hit_share": _known(pair.hit_share),
        }
        for pair in found.link_pairs
    ]
    return {"num_sphere_pairs": len(found.pairs), "num_postures": found.num_postures, "pairs": rows}


def pairs_lines(found: "SelfCollisionPairs") -> list[str]:
    """The pairs of links, those that are checked first."""
    header = ("link", "and", "sphere pairs", "gap mm", "touch %", "left out because")
    ordered = sorted(found.link_pairs, key=lambda pair: pair.left_out is not None)
    rows = [(*pair.links, pair.num_sphere_pairs, *_gap(pair), pair.left_out or "") for pair in ordered]
    kept = len(found.link_pairs) - len(found.left_out)
    sampled = f", gaps over {found.num_postures} postures" if found.num_postures else ""
    summary = (
        f"{len(found.pairs)} pairs of spheres on {kept} pairs of links are checked, {len(found.left_out)} left out"
    )
    return [*table(header, rows), "", summary + sampled]


def info_json(model: "RobotModel", locked: Mapping[str, float]) -> dict[str, Any]:
    """Joints, links and spheres, for ``--json``."""
    joints = [
        {"name": name, "lower": _known(lower), "upper": _known(upper), "velocity": _known(velocity)}
        for name, lower, upper, velocity in _joints(model)
    ]
    return {
        "urdf": str(model.urdf.path),
        "joints": joints,
        "locked": dict(locked),
        "links": list(model.urdf.links),
        "collision_links": list(model.urdf.collision_links),
        "num_meshes": len(model.urdf.meshes),
        "num_shapes": len(model.urdf.shapes),
        "num_spheres": len(model.sphere_set.radii),
        "doubts": _doubts(model),
    }


def info_lines(model: "RobotModel", locked: Mapping[str, float]) -> list[str]:
    """Joints with limits, locked joints, a row per link, and doubts."""
    kinds = {joint.name: joint.kind for joint in model.urdf.joints}
    rows = [
        (name, kinds[name], _number(lower), _number(upper), _number(velocity))
        for name, lower, upper, velocity in _joints(model)
    ]
    lines = table(("joint", "type", "lower", "upper", "velocity"), rows)
    lines += [f"locked: {name} = {value:g}" for name, value in locked.items()]
    shapes = [*(shape.link for shape in model.urdf.shapes), *(mesh.link for mesh in model.urdf.meshes)]
    bodies = model.urdf.rigid_bodies(model.joint_names)
    links = [
        (link, bodies[link][0], shapes.count(link), model.sphere_set.links.count(link)) for link in model.urdf.links
    ]
    lines += ["", *table(("link", "moves with", "collision shapes", "spheres"), links), ""]
    return [
        *lines,
        f"{model.num_joints} joints, in rad, m and s; {len(model.sphere_set.radii)} spheres",
        *_doubts(model),
    ]


def _doubts(model: "RobotModel") -> list[str]:
    return list(model.doubts) if len(model.sphere_set.radii) else []


def _joints(model: "RobotModel") -> list[tuple[str, float, float, float]]:
    limits = zip(model.joint_names, model.lower, model.upper, model.velocity_limit, strict=True)
    return [(name, float(lower), float(upper), float(velocity)) for name, lower, upper, velocity in limits]


def _summary(report: "CoverageReport") -> str:
    share = f"{100 * report.uncovered_share:.1f} % of the surface outside"
    out = f"sticking out by at most {1e3 * report.max_protrusion:.1f} mm"
    if report.worst is None or report.max_deficit is None:
        return f"{report.num_spheres} spheres: {share}, {out}"
    if report.max_deficit == 0:
        return f"{report.num_spheres} spheres cover all of the collision surface (proven), {out}"
    return (
        f"{report.num_spheres} spheres: {share}, by at most {1e3 * report.max_deficit:.2f} mm (proven; at "
        f"{report.worst.link}), {out}"
    )


def _row(link: "LinkCoverage") -> tuple[object, ...]:
    area = f"{1e4 * link.area:.0f}"
    if link.deficit is None:
        return link.link, link.num_spheres, area, "100.0", "no sphere", "", "-"
    place = ", ".join(f"{1e3 * value:.0f}" for value in link.deficit.place) if not link.is_covered else ""
    deficit = f"{1e3 * max(0.0, link.deficit.proven):.2f}"
    sticks_out = f"{1e3 * link.protrusion:.1f}" if link.num_spheres else "-"
    return link.link, link.num_spheres, area, f"{100 * link.uncovered_share:.1f}", deficit, place, sticks_out


def _link_json(link: "LinkCoverage") -> dict[str, Any]:
    deficit = link.deficit
    return {
        "link": link.link,
        "num_spheres": link.num_spheres,
        "area": link.area,
        "uncovered_share": link.uncovered_share,
        "uncovered_bounds": [bound / link.area for bound in link.uncovered_bounds],
        "deficit": None if deficit is None else max(0.0, deficit.proven),
        "deficit_found": None if deficit is None else max(0.0, deficit.found),
        "place": None if deficit is None else deficit.place.tolist(),
        "protrusion": link.protrusion,
        "worst_sphere": link.worst_sphere,
        "is_closed": link.is_closed,
    }


def _gap(pair: "LinkPair") -> tuple[str, str]:
    if math.isnan(pair.least_gap):
        return "-", "-"
    return f"{1e3 * pair.least_gap:.0f} to {1e3 * pair.largest_gap:.0f}", f"{100 * pair.hit_share:.1f}"


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _number(value: float) -> str:
    return f"{value:.4f}" if math.isfinite(value) else "-"
