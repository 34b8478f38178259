"""``splatctrl robot``: collision spheres, self-collision pairs, learned parts."""

import argparse
import math

from splatctrl_cli.cli.common import Console, remarks, request_of, table
from splatctrl_cli.config.fixed import DEFAULT_SPHERES
from splatctrl_cli.files.output import finite
from splatctrl_cli.jobs.reconstruct.reconstruct import LearnRequest, learn_robot
from splatctrl_cli.jobs.robot.robot import (
    CoverageResult,
    RobotRequest,
    bare_links,
    check_robot,
    coverage_summary,
    describe_robot,
    fit_robot,
    robot_pairs,
)
from splatctrl_cli.robot.coverage import LinkCoverage
from splatctrl_cli.robot.self_collision import LinkPair
from splatctrl_cli.robot.self_model import LearnedLink
from splatctrl_cli.robot.sphere_fit import FitOptions

LEARNED = ("num_pixels", "num_configurations", "area", "outside_95", "outside_most", "since")


def run_spheres(args: argparse.Namespace, console: Console) -> int:
    limits = {} if args.max_spheres or args.max_protrusion else {"max_spheres": DEFAULT_SPHERES}
    fit = request_of(FitOptions, args, **limits)
    return _conclude(console, fit_robot(request_of(RobotRequest, args, fit=fit), console))


def run_check(args: argparse.Namespace, console: Console) -> int:
    return _conclude(console, check_robot(request_of(RobotRequest, args)))


def run_pairs(args: argparse.Namespace, console: Console) -> int:
    pairs, document = robot_pairs(request_of(RobotRequest, args))
    ordered = sorted(pairs.link_pairs, key=lambda pair: pair.left_out is not None)
    rows = [(*pair.links, pair.num_sphere_pairs, *_gap(pair), pair.left_out or "") for pair in ordered]
    num_pairs = len(pairs.link_pairs) - len(pairs.left_out)
    sampled = f", gaps over {pairs.num_postures} postures" if pairs.num_postures else ""
    num_left = len(pairs.left_out)
    summary = f"{len(pairs.pairs)} pairs of spheres on {num_pairs} pairs of links are checked, {num_left} left out"
    foreign, of_srdf = document["num_foreign_pairs"], args.srdf and args.srdf.name
    lines = [
        *table(("link", "and", "sphere pairs", "gap mm", "touch %", "left out because"), rows),
        "",
        summary + sampled,
        *remarks((f"{foreign} pairs of {of_srdf} name links that {args.urdf.name} does not have", foreign)),
        *document["doubts"],
    ]
    return console.result(document, lines)


def run_info(args: argparse.Namespace, console: Console) -> int:
    model, document = describe_robot(request_of(RobotRequest, args))
    urdf, lost = model.urdf, document["meshes_not_found"]
    kinds = {joint.name: joint.kind for joint in urdf.joints}
    joints = [
        (name, kinds[name], *("-" if value is None else f"{value:.4f}" for value in limits))
        for name, *limits in (joint.values() for joint in document["joints"])
    ]
    shapes = [*(shape.link for shape in urdf.shapes), *(mesh.link for mesh in urdf.meshes)]
    bodies = urdf.rigid_bodies(model.joint_names)
    links = [(link, bodies[link][0], shapes.count(link), model.sphere_set.links.count(link)) for link in urdf.links]
    lines = [
        *table(("joint", "type", "lower", "upper", "velocity"), joints),
        *(f"locked: {name} = {value:g}" for name, value in document["locked"].items()),
        "",
        *table(("link", "moves with", "collision shapes", "spheres"), links),
        "",
        f"{model.num_joints} joints, in rad, m and s; {len(model.sphere_set.radii)} spheres",
        *document["doubts"],
        *(f"{len(lost)} of {len(urdf.meshes)} meshes are not found: {first}" for first in lost[:1]),
    ]
    return console.result(document, lines)


def run_learn(args: argparse.Namespace, console: Console) -> int:
    request = request_of(LearnRequest, args)
    model = learn_robot(request, console)
    having, links = ({part.link for part in parts} for parts in (model.parts, model.learned))
    lines = [
        f"{len(having)} of {len(links)} learned links have parts that {args.urdf.name} does not have",
        "",
        *table(
            ("link", "pixels", "postures", "parts cm2", "outside 95 % mm", "most mm", "at x, y, z mm", "since s"),
            [_learned_row(part) for part in model.learned],
        ),
        "",
        *(part.words(part.first_ns) for part in model.parts),
        *(f"not learned (what is fixed to it is scene): {link} {why}" for link, why in model.unknown.items()),
        f"written: {request.out}",
    ]
    return console.result(
        {
            "out": str(request.out),
            "links": [
                {name: finite(getattr(part, name)) for name in LEARNED}
                | {"link": part.link, "words": part.words(part.first_ns), "place": [*map(finite, part.place)]}
                for part in model.learned
            ],
            "unknown": dict(model.unknown),
        },
        lines,
    )


def _learned_row(part: LearnedLink) -> tuple[object, ...]:
    outside = [f"{1e3 * value:.1f}" for value in (part.outside_95, part.outside_most)]
    place = ", ".join(f"{1e3 * value:.0f}" for value in part.place) if len(part.triangles) else ""
    since = f"{part.since:.1f}" if len(part.triangles) else ""
    return part.link, part.num_pixels, part.num_configurations, f"{1e4 * part.area:.0f}", *outside, place, since


def _conclude(console: Console, result: CoverageResult) -> int:
    report = result.report
    unclosed = (
        f"not closed: {', '.join(report.open_links)}: distances to the surface are right; without an inside, "
        "spheres protrude from its convex hull"
    )
    lines = [
        *table(
            ("link", "spheres", "area cm2", "uncovered %", "deficit mm", "at x, y, z mm", "sticks out mm"),
            [_row(link) for link in report.links],
        ),
        "",
        coverage_summary(report),
        *remarks(
            (bare_links(report), report.bare_links),
            (unclosed, report.open_links),
            (f"{report.stray_spheres} spheres are on links without collision geometry", report.stray_spheres),
        ),
        *result.notes,
    ]
    return console.show(result, lines, has_findings=True)


def _row(link: LinkCoverage) -> tuple[object, ...]:
    area = f"{1e4 * link.area:.0f}"
    if link.deficit is None:
        return link.link, link.num_spheres, area, "100.0", "no sphere", "", "-"
    place = ", ".join(f"{1e3 * value:.0f}" for value in link.deficit.place) if not link.is_covered else ""
    deficit = f"{1e3 * max(0.0, link.deficit.proven):.2f}"
    sticks_out = f"{1e3 * link.protrusion:.1f}" if link.num_spheres else "-"
    return link.link, link.num_spheres, area, f"{100 * link.uncovered_share:.1f}", deficit, place, sticks_out


def _gap(pair: LinkPair) -> tuple[str, str]:
    if math.isnan(pair.least_gap):
        return "-", "-"
    return f"{1e3 * pair.least_gap:.0f} to {1e3 * pair.largest_gap:.0f}", f"{100 * pair.hit_share:.1f}"
