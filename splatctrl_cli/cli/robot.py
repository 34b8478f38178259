"""``splatctrl robot``: collision spheres, self-collision pairs, learned parts."""

import argparse
import math
from collections.abc import Iterator

from splatctrl_cli.cli.common import Console, locked_joints, request_of, source_options, table
from splatctrl_cli.config.fixed import DEFAULT_SPHERES
from splatctrl_cli.files.output import finite
from splatctrl_cli.jobs.reconstruct.reconstruct import LearnRequest, learn_robot
from splatctrl_cli.jobs.robot.robot import (
    CoverageResult,
    PairsResult,
    RobotRequest,
    RobotResult,
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
from splatctrl_cli.robot.sphere_files import RENAMED
from splatctrl_cli.robot.sphere_fit import FitOptions

LEARNED = ("num_pixels", "num_configurations", "area", "outside_95", "outside_most", "since")


def run_spheres(args: argparse.Namespace) -> int:
    console, fit = Console(args), request_of(FitOptions, args)
    if args.max_spheres is None and args.max_protrusion is None:
        fit = request_of(FitOptions, args, max_spheres=DEFAULT_SPHERES)
    result = fit_robot(request_of(RobotRequest, args, fit=fit), console)
    return console.concluded(
        result.verdict,
        {"urdf": str(args.urdf), "spheres": str(result.spheres), "seed": args.seed, **result.as_dict()},
        [*_coverage_lines(result), "", f"written: {result.spheres}"],
        has_findings=True,
    )


def run_check(args: argparse.Namespace) -> int:
    result = check_robot(request_of(RobotRequest, args))
    file, left_out = result.file, list(result.links_left_out)
    assert file is not None
    found = {
        "urdf": str(args.urdf),
        "spheres": str(result.spheres),
        "layout": file.layout,
        "num_switched_off": file.num_off,
        "links_left_out": left_out,
        **result.as_dict(),
    }
    lines = [*_coverage_lines(result)]
    if file.num_off:
        lines.append(f"{file.num_off} spheres are switched off (radius 0 or less) and cover nothing")
    if result.is_renamed:
        lines.append(RENAMED)
    if left_out:
        lines.append(f"spheres of {', '.join(left_out)} are left out: {args.urdf.name} has no such link")
    return Console(args).concluded(result.verdict, found, lines, has_findings=True)


def run_pairs(args: argparse.Namespace) -> int:
    result = robot_pairs(request_of(RobotRequest, args, locked=locked_joints(args)))
    lines = _pairs_lines(result)
    if result.num_foreign:
        lines.append(f"{result.num_foreign} pairs of {args.srdf.name} name links that {args.urdf.name} does not have")
    found = {
        "urdf": str(args.urdf),
        "seed": args.seed,
        "num_foreign_pairs": result.num_foreign,
        **result.as_dict(),
        "doubts": list(result.doubts),
    }
    return Console(args).result(found, [*lines, *result.doubts])


def run_info(args: argparse.Namespace) -> int:
    result = describe_robot(request_of(RobotRequest, args, locked=locked_joints(args)))
    return Console(args).result(result.as_dict(), _robot_lines(result))


def run_learn(args: argparse.Namespace) -> int:
    console = Console(args)
    request = request_of(LearnRequest, args, options=source_options(args), locked=locked_joints(args))
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


def _coverage_lines(result: CoverageResult) -> Iterator[str]:
    report = result.report
    yield from (
        *table(
            ("link", "spheres", "area cm2", "uncovered %", "deficit mm", "at x, y, z mm", "sticks out mm"),
            [_row(link) for link in report.links],
        ),
        "",
        coverage_summary(report),
    )
    if report.bare_links:
        yield bare_links(report)
    if report.open_links:
        yield (
            f"not closed: {', '.join(report.open_links)}: what is said of the surface holds; an inside there is not, "
            "so spheres stick out of its convex hull"
        )
    if report.stray_spheres:
        yield f"{report.stray_spheres} spheres are on links without collision geometry"


def _pairs_lines(result: PairsResult) -> list[str]:
    found, header = result.found, ("link", "and", "sphere pairs", "gap mm", "touch %", "left out because")
    ordered = sorted(found.link_pairs, key=lambda pair: pair.left_out is not None)
    rows = [(*pair.links, pair.num_sphere_pairs, *_gap(pair), pair.left_out or "") for pair in ordered]
    kept = len(found.link_pairs) - len(found.left_out)
    sampled = f", gaps over {found.num_postures} postures" if found.num_postures else ""
    summary = (
        f"{len(found.pairs)} pairs of spheres on {kept} pairs of links are checked, {len(found.left_out)} left out"
    )
    return [*table(header, rows), "", summary + sampled]


def _robot_lines(result: RobotResult) -> list[str]:
    model, urdf = result.model, result.model.urdf
    kinds = {joint.name: joint.kind for joint in urdf.joints}
    joints = [
        (name, kinds[name], *(f"{value:.4f}" if math.isfinite(value) else "-" for value in limits))
        for name, *limits in result.joints
    ]
    shapes = [*(shape.link for shape in urdf.shapes), *(mesh.link for mesh in urdf.meshes)]
    bodies = urdf.rigid_bodies(model.joint_names)
    links = [(link, bodies[link][0], shapes.count(link), model.sphere_set.links.count(link)) for link in urdf.links]
    lost = result.lost_meshes
    return [
        *table(("joint", "type", "lower", "upper", "velocity"), joints),
        *(f"locked: {name} = {value:g}" for name, value in result.locked.items()),
        "",
        *table(("link", "moves with", "collision shapes", "spheres"), links),
        "",
        f"{model.num_joints} joints, in rad, m and s; {len(model.sphere_set.radii)} spheres",
        *result.doubts,
        *([f"{len(lost)} of {len(urdf.meshes)} meshes are not found: {lost[0]}"] if lost else []),
    ]


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
