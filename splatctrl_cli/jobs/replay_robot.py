"""The robot of a replay: its model, what its spheres leave uncovered, and which of its links may touch."""

from pathlib import Path

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.replay_request import ReplayRequest
from splatctrl_cli.robot.coverage import LinkCoverage, coverage_deficit
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import never_apart, without_disabled
from splatctrl_cli.robot.srdf import read_srdf

FR3_LIMITS = (
    "an FR3 refuses speeds near its position limits that its URDF allows; set control.velocity_limits = fr3 to keep "
    "the published ones"
)
COARSE = 0.02  # [m] of areas, which a replay does not report; the deficit is as exact as ever


def read_robot(request: ReplayRequest, config: "ControlConfig") -> "RobotModel":
    """The model of the arguments, its spheres measured against the URDF's collision geometry where that can be read.

    Raises InputError where `config.coverage` is "margin" and no distance bounds what is uncovered.
    """

    T_world_base = None if request.base is None else transform_from(request.base[:3], request.base[3:])
    model = RobotModel.from_urdf(
        request.urdf, request.spheres, T_world_base=T_world_base, locked=request.locked, packages=request.packages
    )
    if request.srdf is not None:
        disabled, _ = read_srdf(request.srdf, model.urdf)
        model = model.with_self_pairs(without_disabled(model, disabled))
    model = _measured(model, list(request.packages))
    if config.coverage == "margin":
        _check_bounded(model)
    return model


def doubts_of(request: ReplayRequest, model: "RobotModel", config: "ControlConfig") -> list[str]:
    """What a person should know of the robot before trusting this replay; a sentence each."""

    if request.mode == "audit":
        return list(model.doubts)
    found = never_apart(model, config.self_margin)
    is_fr3 = all(name.startswith("fr3_joint") for name in model.joint_names)
    return [
        *model.doubts,
        *([FR3_LIMITS] if is_fr3 and config.velocity_limits == "urdf" else []),
        *(
            f"{' and '.join(pair.links)}: their spheres are no farther than {1e3 * pair.largest_gap:.1f} mm apart in "
            f"any posture sampled: control.self_margin = {1e3 * config.self_margin:g} mm cannot be kept; lower it, "
            "or leave the pair out (--srdf)"
            for pair in found
        ),
    ]


def coverage_words(model: "RobotModel", config: "ControlConfig") -> str:
    """What the spheres leave uncovered, or why that is not known, and the margin that then holds for the surface."""
    report = model.coverage
    if report is None:
        return f"how much of the surface the spheres cover is not known: {model.coverage_unknown}"
    if not report.bare_links and report.max_deficit == 0:
        return "the spheres cover all of the collision surface (proven): the margin is that of the surface"
    far = max((link for link in report.links if link.deficit is not None), key=_proven, default=None)
    words = "no link has spheres" if far is None else f"the spheres leave up to {1e3 * _proven(far):.2f} mm uncovered"
    words += "" if far is None else f" ({far.link})"
    if config.coverage == "margin":
        words += (
            f"; their rows keep that much more, link by link, so that the surface keeps {1e3 * config.margin:g} mm"
        )
    else:
        left = 1e3 * (config.margin - (0.0 if far is None else _proven(far)))
        words += f"; where they keep {1e3 * config.margin:g} mm the surface keeps " + (
            f"{left:.2f} mm" if left > 0 else "nothing for certain"
        )
    bare = f", and nothing of {', '.join(report.bare_links)}, which have no sphere" if report.bare_links else ""
    return words + bare


def _measured(model: "RobotModel", packages: list[Path]) -> "RobotModel":

    try:
        return model.with_coverage(
            coverage_deficit(model.urdf, model.sphere_set, folders=packages, resolution=COARSE)
        )
    except InputError as error:
        return model.with_coverage(None, str(error))


def _check_bounded(model: "RobotModel") -> None:
    """Raise InputError where a link that moves has no sphere, or nothing was measured."""
    wanted = "control.coverage = margin"
    if model.coverage is None:
        raise InputError(
            f"{wanted}: {model.coverage_unknown}", remedy="or set control.coverage = report, which needs no meshes"
        )
    bodies = model.urdf.rigid_bodies()
    children = {child for _, child in model.urdf.parents}
    bare = [link for link in model.coverage.bare_links if bodies[link][0] in children]
    if bare:
        raise InputError(
            f"{wanted}: expected spheres on every link that moves, got none on {', '.join(bare)}",
            remedy=f"fit a set that covers them: splatctrl robot spheres --urdf {model.urdf.path.name}",
        )


def _proven(link: "LinkCoverage") -> float:
    return 0.0 if link.deficit is None else max(0.0, link.deficit.proven)
