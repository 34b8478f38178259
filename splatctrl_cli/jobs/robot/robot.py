"""Jobs of `robot`: fit and measure spheres, list self-collision pairs, describe."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, ERROR, FAULTS
from splatctrl_cli.evaluate.verdict import (
    JudgedResult,
    Outcome,
    Reason,
    Verdict,
    check_gate_names,
    gate_reasons,
    note,
    parse_gate,
    verdict_of,
)
from splatctrl_cli.files.output import finite, output_path
from splatctrl_cli.geometry import transform_points
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.records import SphereSet
from splatctrl_cli.report.pictures import robot_picture
from splatctrl_cli.robot.coverage import CoverageReport, coverage_of_solids
from splatctrl_cli.robot.link_meshes import Solid, mesh_path, read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import SelfCollisionPairs, read_srdf, self_collision_pairs
from splatctrl_cli.robot.sphere_files import (
    RENAMED,
    are_links_renamed,
    match_links,
    own_spheres,
    read_sphere_file,
    read_spheres,
    spheres_yaml,
)
from splatctrl_cli.robot.sphere_fit import FitOptions, fit_spheres
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf

# [m] that a controller keeps: surface farther outside its sphere may still touch
DEFAULT_MARGIN = ControlConfig().margin
SCALES = {
    "max_deficit": ERROR,
    "uncovered_share": BAD_SHARE,
    "max_protrusion": ERROR,
    "num_spheres": DESCRIBES,
    **dict.fromkeys(("num_bare_links", "num_open_links", "num_stray_spheres"), FAULTS),
}
METRICS: dict[str, Callable[[CoverageReport], float | None]] = {  # lengths [m], None if unbounded
    "max_deficit": lambda report: report.max_deficit,
    "uncovered_share": lambda report: report.uncovered_share,
    "max_protrusion": lambda report: report.max_protrusion,
    "num_spheres": lambda report: report.num_spheres,
    "num_bare_links": lambda report: len(report.bare_links),
    "num_open_links": lambda report: len(report.open_links),
    "num_stray_spheres": lambda report: report.stray_spheres,
}


@dataclass(frozen=True, kw_only=True)
class RobotRequest(RobotOptions):
    """Robot, and the options of its jobs.

    Fit and check use `picture` and gates `require` on METRICS. Pairs uses `srdf`, or `postures` to sample, and
    `drop_never` to omit pairs that are never close.
    """

    urdf: Path
    picture: Path | None = None
    require: tuple[str, ...] = ()
    out: Path = Path("spheres.yaml")
    fit: FitOptions = field(default_factory=lambda: FitOptions(max_spheres=fixed.DEFAULT_SPHERES))
    force: bool = False
    srdf: Path | None = None
    postures: int = 2000
    drop_never: bool = False
    seed: int = 0


@dataclass(frozen=True, kw_only=True, repr=False)
class CoverageResult(JudgedResult):
    """Coverage of a robot by spheres; notes: on the sphere file."""

    report: CoverageReport


def _figures(report: CoverageReport) -> dict[str, Any]:
    links = [
        {
            "link": link.link,
            "num_spheres": link.num_spheres,
            "area": link.area,
            "uncovered_share": link.uncovered_share,
            "uncovered_bounds": [bound / link.area for bound in link.uncovered_bounds],
            "deficit": None if link.deficit is None else max(0.0, link.deficit.proven),
            "deficit_found": None if link.deficit is None else max(0.0, link.deficit.lower),
            "place": None if link.deficit is None else link.deficit.place.tolist(),
            "protrusion": link.protrusion,
            "worst_sphere": link.worst_sphere,
            "is_closed": link.is_closed,
        }
        for link in report.links
    ]
    return {"metrics": {name: of(report) for name, of in METRICS.items()}, "links": links}


def fit_robot(request: RobotRequest, progress: Progress = SILENT) -> CoverageResult:
    """Fit spheres to each link's collision geometry; write and measure them."""
    check_gate_names(request.require, METRICS)
    with output_path(request.out, force=request.force, is_folder=False) as partial:
        urdf = read_urdf(request.urdf)
        solids = read_solids(urdf, request.packages)
        progress.log(f"robot spheres: fitting {len(solids)} links")
        fitted = fit_spheres(solids, request.fit)
        report = coverage_of_solids(urdf, solids, fitted)
        partial.write_text(spheres_yaml(fitted, _comments(request.urdf, report)), encoding="utf-8")
    spheres = read_spheres(request.out)
    if request.picture is not None:
        _draw(request.picture, urdf, solids, spheres)
    allowed = max(DEFAULT_MARGIN, request.fit.max_deficit)
    return CoverageResult(
        report=report,
        verdict=_verdict(report, urdf, solids, "robot spheres", request.require, allowed),
        document={"urdf": str(request.urdf), "spheres": str(request.out), "seed": request.seed, **_figures(report)},
        notes=("", f"written: {request.out}"),
    )


def check_robot(request: RobotRequest) -> CoverageResult:
    """Measure how much of the collision surface spheres cover."""
    check_gate_names(request.require, METRICS)
    urdf, path = read_urdf(request.urdf), request.spheres or request.urdf
    file = read_sphere_file(path)
    spheres, left_out = match_links(file.spheres, urdf, str(path))
    solids = read_solids(urdf, request.packages)
    report = coverage_of_solids(urdf, solids, spheres)
    if request.picture is not None:
        _draw(request.picture, urdf, solids, spheres)
    texts = {
        f"{file.num_off} spheres are switched off (radius 0 or less) and cover nothing": file.num_off,
        RENAMED: are_links_renamed(file.spheres, urdf),
        f"spheres of {', '.join(left_out)} are left out: {request.urdf.name} has no such link": left_out,
    }
    document = {
        "urdf": str(request.urdf),
        "spheres": str(path),
        "layout": file.layout,
        "num_switched_off": file.num_off,
        "links_left_out": list(left_out),
    }
    return CoverageResult(
        report=report,
        verdict=_verdict(report, urdf, solids, "robot check", request.require, DEFAULT_MARGIN),
        document=document | _figures(report),
        notes=tuple(text for text, holds in texts.items() if holds),
    )


def robot_pairs(request: RobotRequest) -> tuple[SelfCollisionPairs, dict[str, Any]]:
    """Find link pairs that may collide, and why other pairs cannot; also as a document."""
    model = RobotModel.from_urdf(request.urdf, request.spheres, locked=request.locked)
    disabled, foreign = ({}, []) if request.srdf is None else read_srdf(request.srdf, model.urdf)
    pairs = self_collision_pairs(
        model, disabled, num_postures=request.postures, seed=request.seed, drop_never=request.drop_never
    )
    return pairs, {
        "urdf": str(request.urdf),
        "seed": request.seed,
        "num_foreign_pairs": len(foreign),
        "num_sphere_pairs": len(pairs.pairs),
        "num_postures": pairs.num_postures,
        "pairs": [
            {
                "links": list(pair.links),
                "left_out": pair.left_out,
                "sphere_pairs": pair.num_sphere_pairs,
                "least_gap": finite(pair.least_gap),
                "largest_gap": finite(pair.largest_gap),
                "hit_share": finite(pair.hit_share),
            }
            for pair in pairs.link_pairs
        ],
        "doubts": list(model.doubts),
    }


def describe_robot(request: RobotRequest) -> tuple[RobotModel, dict[str, Any]]:
    """Read a robot, and describe it. By default the spheres are the URDF's own.

    Limits are in rad or m, velocities per second; meshes_not_found: error sentences.
    """
    urdf, lost = read_urdf(request.urdf), []
    locked = urdf.add_followers(request.locked)
    spheres = own_spheres(urdf) if request.spheres is None else request.spheres
    model = RobotModel.from_urdf(request.urdf, spheres, locked=locked)
    for mesh in urdf.meshes:
        try:
            mesh_path(urdf.path, mesh, request.packages)
        except InputError as error:
            lost.append(str(error))
    rows = np.column_stack([model.lower, model.upper, model.velocity_limit]).tolist()
    limits = zip(model.joint_names, rows, strict=True)
    return model, {
        "urdf": str(model.urdf.path),
        "joints": [
            {"name": name, "lower": finite(lower), "upper": finite(upper), "velocity": finite(velocity)}
            for name, (lower, upper, velocity) in limits
        ],
        "locked": dict(locked),
        "links": list(model.urdf.links),
        "collision_links": list(model.urdf.collision_links),
        "num_meshes": len(model.urdf.meshes),
        "num_shapes": len(model.urdf.shapes),
        "num_spheres": len(model.sphere_set.radii),
        "doubts": list(model.doubts) if len(model.sphere_set.radii) else [],
        "meshes_not_found": lost,
    }


def coverage_summary(report: CoverageReport) -> str:
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


def bare_links(report: CoverageReport) -> str:
    bare = ", ".join(report.bare_links)
    return f"no sphere covers {bare}: these links are not judged" if bare else ""


def _verdict(
    report: CoverageReport,
    urdf: UrdfFile,
    solids: Mapping[str, tuple[Solid, ...]],
    command: str,
    require: Sequence[str],
    allowed: float,
) -> Verdict:
    """Fail for surface more than `allowed` [m] outside the spheres, or a bare moving link.

    A gate on max_deficit replaces the limit.
    """
    num, bare = len(report.links), bare_links(report)
    counts = dict.fromkeys(METRICS, num) | dict.fromkeys(("max_protrusion", "num_stray_spheres"), report.num_spheres)
    covered = Reason(
        criterion="coverage",
        outcome=Outcome.PASSED,
        sentence=coverage_summary(report),
        value=report.max_deficit,
        threshold=allowed,
        unit="m",
        count=num,
    )
    is_gated = any(parse_gate(requirement)[0] == "max_deficit" for requirement in require)
    if (faults := _uncovered_links(report, urdf, allowed)) and not is_gated:
        covered = replace(
            covered,
            outcome=Outcome.FAILED,
            sentence=f"{', '.join(faults[:3])}{', ...' * (len(faults) > 3)}: {len(faults)} of {num} links, allowed"
            f" {1e3 * allowed:g} mm",
            remedy="fit a set with 'splatctrl robot spheres', or give --require 'max_deficit<=...' [m]",
        )
    return verdict_of(
        command,
        [
            covered,
            *([note(criterion="coverage", sentence=bare)] if bare else []),
            *gate_reasons(require, {name: of(report) for name, of in METRICS.items()}, counts),
        ],
        scope=f"{report.num_spheres} spheres on {num} links",
        notes=dict.fromkeys(part.surface.note for parts in solids.values() for part in parts if part.surface.note),
        counts=counts,
    )


def _uncovered_links(report: CoverageReport, urdf: UrdfFile, allowed: float) -> list[str]:
    bodies, root = urdf.rigid_bodies(), urdf.root
    bare = [f"{link} moves and has no sphere" for link in report.bare_links if bodies[link][0] != root]
    far = [(link.deficit.proven, link.link) for link in report.links if link.deficit is not None]
    return bare + [f"{link} is up to {1e3 * far:.1f} mm outside" for far, link in sorted(far)[::-1] if far > allowed]


def _comments(urdf: Path, report: CoverageReport) -> list[str]:
    deficit, protrusion = report.max_deficit, 1e3 * report.max_protrusion
    covered = "cover all of it" if deficit == 0 else f"leave at most {1e3 * (deficit or 0.0):.2f} mm of it outside"
    return [
        f"Collision spheres for {urdf.name}, fitted by: splatctrl robot spheres. In metres, in each link's frame.",
        f"{report.num_spheres} spheres {covered} (proven); they stick out by {protrusion:.1f} mm at most.",
    ]


def _draw(path: Path, urdf: UrdfFile, solids: Mapping[str, tuple[Solid, ...]], spheres: SphereSet) -> None:
    model = RobotModel.from_urdf(urdf.path, spheres)
    poses = {link: model.frame_pose(model.middle, link) for link in {*solids, *spheres.links}}
    triangles = [
        transform_points(poses[link], part.surface.corners) for link, parts in solids.items() for part in parts
    ]
    robot_picture(path, triangles, model.sphere_centers(model.middle), model.sphere_set.radii)
