"""``splatctrl robot``: fit collision spheres, measure a set of them, list self-collision pairs, show a robot."""

import argparse
from pathlib import Path

import numpy as np

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_gates, add_named, add_output
from splatctrl_cli.cli.numbers import MAX_SEED, real, whole
from splatctrl_cli.cli.robot_options import add_lock, add_robot, locked_joints
from splatctrl_cli.cli.robot_report import (
    METRICS,
    coverage_json,
    coverage_lines,
    coverage_verdict,
    info_json,
    info_lines,
    pairs_json,
    pairs_lines,
)
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.gates import check_gate_names
from splatctrl_cli.files.output import output_path
from splatctrl_cli.geometry import transform_points
from splatctrl_cli.records import SphereSet
from splatctrl_cli.report.robot_picture import robot_picture
from splatctrl_cli.robot.coverage import CoverageReport, coverage_of_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import self_collision_pairs
from splatctrl_cli.robot.solids import Solid, mesh_path, read_solids
from splatctrl_cli.robot.sphere_files import read_sphere_file, read_spheres, spheres_yaml
from splatctrl_cli.robot.sphere_fit import FitOptions, fit_spheres
from splatctrl_cli.robot.spheres import RENAMED, are_links_renamed, matched_links
from splatctrl_cli.robot.srdf import read_srdf
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf

DEFAULT_SPHERES = 64  # as many as the public sets for the Panda have


def register(subparsers: Subparsers) -> None:
    """Add the subcommand and its actions to the parser."""
    parser = add_named(subparsers, "robot")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    _register_spheres(actions)
    _register_check(actions)
    _register_pairs(actions)
    _register_info(actions)


def _register_spheres(actions: Subparsers) -> None:
    parser = add_command(
        actions, "spheres", run_spheres, summary="fit spheres that cover all of each link's collision geometry"
    )
    add_robot(parser)
    add_output(parser, default="spheres.yaml", what="YAML file of the spheres")
    number = parser.add_mutually_exclusive_group()
    number.add_argument(
        "--max-spheres",
        type=whole(1, 100_000),
        metavar="N",
        help=f"spheres over all links, sticking out as little as that allows (default: {DEFAULT_SPHERES})",
    )
    number.add_argument(
        "--max-protrusion",
        type=real(1e-6, 10, "m"),
        metavar="M",
        help="or: the fewest found that stick out no more [m]",
    )
    parser.add_argument(
        "--max-deficit",
        type=real(0, 10, "m"),
        default=0.0,
        metavar="M",
        help="how far surface points may stay outside all spheres [m] (default: 0, all are covered)",
    )
    parser.add_argument("--seed", type=whole(0, MAX_SEED), default=0, help="seed of the greedy covers (default: 0)")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the spheres over the collision shapes")
    add_gates(parser)


def _register_check(actions: Subparsers) -> None:
    parser = add_command(
        actions, "check", run_check, summary="measure how much of the collision surface a set of spheres covers"
    )
    add_robot(parser, spheres="YAML (also cuRobo's) or URDF with the spheres (default: those of the URDF itself)")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the spheres over the collision shapes")
    add_gates(parser)


def _register_pairs(actions: Subparsers) -> None:
    parser = add_command(
        actions, "pairs", run_pairs, summary="list which links may collide with each other, and why others may not"
    )
    add_robot(parser, spheres="YAML (also cuRobo's) or URDF with the spheres (default: those of the URDF itself)")
    add_lock(parser)
    parser.add_argument("--srdf", type=Path, metavar="FILE", help="leave out what its disable_collisions name")
    parser.add_argument(
        "--postures",
        type=whole(1, 10_000_000),
        default=2000,
        metavar="N",
        help="without --srdf: joint configurations sampled (default: 2000)",
    )
    parser.add_argument(
        "--drop-never", action="store_true", help="leave out what never comes near in the sample (a guess, no proof)"
    )
    parser.add_argument("--seed", type=whole(0, MAX_SEED), default=0, help="seed of the sampling (default: 0)")


def _register_info(actions: Subparsers) -> None:
    parser = add_command(actions, "info", run_info, summary="show joints with limits, links, shapes and spheres")
    add_robot(parser, spheres="YAML (also cuRobo's) or URDF with the spheres (default: none, or those of the URDF)")
    add_lock(parser)


def run_spheres(args: argparse.Namespace) -> int:
    """Fit, write, measure what was written, and return the exit code."""
    console = Console(args)
    check_gate_names(args.require, METRICS)
    num_spheres = DEFAULT_SPHERES if args.max_spheres is None and args.max_protrusion is None else args.max_spheres
    options = FitOptions(
        max_spheres=num_spheres, max_protrusion=args.max_protrusion, max_deficit=args.max_deficit, seed=args.seed
    )
    out = args.out or Path("spheres.yaml")
    with output_path(out, force=args.force, is_folder=False) as partial:
        urdf = read_urdf(args.urdf)
        solids = read_solids(urdf, args.packages)
        console.log(f"robot spheres: fitting {len(solids)} links")
        fitted = fit_spheres(solids, options)
        report = coverage_of_solids(urdf, solids, fitted)
        partial.write_text(spheres_yaml(fitted, _comments(args.urdf, report)), encoding="utf-8")
    spheres = read_spheres(out)
    verdict = coverage_verdict(report, "robot spheres", args.require)
    if args.picture is not None:
        _draw(args.picture, urdf, solids, spheres)
    console.concluded(
        verdict,
        {"urdf": str(args.urdf), "spheres": str(out), "seed": args.seed, **coverage_json(report)},
        [*coverage_lines(report), "", f"written: {out}"],
        verdict.exit_code,
        has_findings=True,
    )
    return verdict.exit_code


def run_check(args: argparse.Namespace) -> int:
    """Measure a set of spheres and return the exit code."""
    console = Console(args)
    check_gate_names(args.require, METRICS)
    urdf = read_urdf(args.urdf)
    path = args.spheres or args.urdf
    file = read_sphere_file(path)
    spheres, left_out = matched_links(file.spheres, urdf, str(path))
    solids = read_solids(urdf, args.packages)
    report = coverage_of_solids(urdf, solids, spheres)
    if args.picture is not None:
        _draw(args.picture, urdf, solids, spheres)
    facts = {"urdf": str(args.urdf), "spheres": str(path), "layout": file.layout}
    notes = {"num_switched_off": file.num_off, "links_left_out": list(left_out)}
    lines = coverage_lines(report)
    if file.num_off:
        lines.append(f"{file.num_off} spheres are switched off (radius 0 or less) and cover nothing")
    if are_links_renamed(file.spheres, urdf):
        lines.append(RENAMED)
    if left_out:
        lines.append(f"spheres of {', '.join(left_out)} are left out: {args.urdf.name} has no such link")
    verdict = coverage_verdict(report, "robot check", args.require)
    result = {**facts, **notes, **coverage_json(report)}
    console.concluded(verdict, result, lines, verdict.exit_code, has_findings=True)
    return verdict.exit_code


def run_pairs(args: argparse.Namespace) -> int:
    """List the pairs of links and return the exit code."""
    console = Console(args)
    model = RobotModel.from_urdf(args.urdf, args.spheres, locked=locked_joints(args.lock))
    disabled, foreign = ((), ()) if args.srdf is None else read_srdf(args.srdf, model.urdf)
    found = self_collision_pairs(
        model, disabled, num_postures=args.postures, seed=args.seed, drop_never=args.drop_never
    )
    lines = pairs_lines(found)
    if foreign:
        lines.append(f"{len(foreign)} pairs of {args.srdf.name} name links that {args.urdf.name} does not have")
    result = {"urdf": str(args.urdf), "seed": args.seed, "num_foreign_pairs": len(foreign), **pairs_json(found)}
    console.result({**result, "doubts": list(model.doubts)}, [*lines, *model.doubts])
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Show the robot and return the exit code."""
    console = Console(args)
    urdf = read_urdf(args.urdf)
    has_own = bool(urdf.shapes) and all(shape.kind == "sphere" for shape in urdf.shapes) and not urdf.meshes
    spheres = args.spheres if args.spheres is not None or has_own else _no_spheres()
    locked = urdf.with_followers(locked_joints(args.lock))
    model = RobotModel.from_urdf(args.urdf, spheres, locked=locked)
    lost = _lost_meshes(urdf, args.packages)
    lines = info_lines(model, locked)
    if lost:
        lines.append(f"{len(lost)} of {len(urdf.meshes)} meshes are not found: {lost[0]}")
    console.result({**info_json(model, locked), "meshes_not_found": lost}, lines)
    return 0


def _lost_meshes(urdf: "UrdfFile", packages: list[Path]) -> list[str]:
    """What is wrong with each mesh of a URDF that is not there."""
    lost = []
    for mesh in urdf.meshes:
        try:
            mesh_path(urdf.path, mesh, packages)
        except InputError as error:
            lost.append(str(error))
    return lost


def _no_spheres() -> "SphereSet":
    return SphereSet(links=(), centers=np.zeros((0, 3)), radii=np.zeros(0))


def _comments(urdf: Path, report: "CoverageReport") -> list[str]:
    """What a person should know of a written set, first lines of its file."""
    deficit, protrusion = report.max_deficit, 1e3 * report.max_protrusion
    covered = "cover all of it" if deficit == 0 else f"leave at most {1e3 * (deficit or 0.0):.2f} mm of it outside"
    return [
        f"Collision spheres for {urdf.name}, fitted by: splatctrl robot spheres. In metres, in each link's frame.",
        f"{report.num_spheres} spheres {covered} (proven); they stick out by {protrusion:.1f} mm at most.",
    ]


def _draw(path: Path, urdf: "UrdfFile", solids: "dict[str, tuple[Solid, ...]]", spheres: "SphereSet") -> None:
    model = RobotModel.from_urdf(urdf.path, spheres)
    poses = {link: model.frame_pose(model.middle, link) for link in {*solids, *spheres.links}}
    triangles = [
        transform_points(poses[link], part.surface.corners) for link, parts in solids.items() for part in parts
    ]
    robot_picture(path, triangles, model.sphere_centers(model.middle), model.sphere_set.radii)
