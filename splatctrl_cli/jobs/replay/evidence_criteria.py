"""Criteria of the evidence behind a replay's verdict."""

from collections.abc import Iterator
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np

from splatctrl_cli.calibration.displacement import is_corrected, is_displaced
from splatctrl_cli.config.fixed import (
    BEYOND,
    COARSE_VOXEL,
    MISPLACED,
    UNSEEN,
    UNSEEN_BY_ONE,
    UNSEEN_BY_TWO,
    UNSEEN_PATH,
)
from splatctrl_cli.evaluate.conformal import ConformalBound
from splatctrl_cli.evaluate.metrics import lowest
from splatctrl_cli.evaluate.verdict import Criterion, Outcome, Reason, not_evaluable, passed_reason
from splatctrl_cli.jobs.reconstruct.verdict import displaced_camera
from splatctrl_cli.jobs.replay.criteria import MARGIN, UNKNOWN, Bound, Judged, mm
from splatctrl_cli.jobs.replay.request import OCCUPIED
from splatctrl_cli.jobs.replay.time_criteria import CLOCKS, evidence_age, judged_time, map_age
from splatctrl_cli.voxels import EvidenceClass

LIMITS = (
    Bound(
        quantity="never seen, of all points within the margin",
        why="nearly all correct recordings of three cameras leave less",
        on="unseen",
        at_most=UNSEEN,
        say="{percent:.0f} % of the space within the margin of the arm was never seen, allowed {allowed_percent:g} %",
        passed="{percent:.0f} % of the space within the margin of the arm was never seen",
        remedy="add a camera that sees where the arm goes",
    ),
    Bound(
        quantity="from a surface of the map to the arm, through a point never seen",
        why="an object may extend into space on its unseen side",
        on="unseen_path",
        unit="m",
        above=UNSEEN_PATH,
        say="a surface of the map is {mm} from the arm through unseen space, expected over {allowed_mm} (the "
        "object may extend to the arm)",
        remedy="add a camera that sees that side",
    ),
    Bound(
        quantity="from a surface of the map to a sphere of the arm with 90 % of the points around it never seen",
        why="space that is almost entirely unseen may hold a whole object",
        on="blind_to_surface",
        unit="m",
        above=BEYOND,
        say="the arm enters space that is over 90 % unseen, {mm} from a surface of the map, allowed {allowed_mm} "
        "(the surface may extend there)",
        remedy="add a camera that sees where the arm goes",
    ),
    Bound(
        quantity="*unanswered*, from the arm",
        why="a dark, shiny or transparent object returns no depth where depth is expected",
        on="class_distance",
        unit="m",
        parts=(EvidenceClass.UNANSWERED,),
        say="no camera measured depth at a place {mm} from the arm, margin {allowed_mm}",
        remedy="a dark, shiny or transparent object may be there: add a camera that gets depth there",
    ),
    Bound(
        quantity="*contradicted*, from the arm",
        why="depth of a shiny object may lie far behind it",
        on="class_distance",
        unit="m",
        parts=(EvidenceClass.CONTRADICTED,),
        say="one camera measures depth behind a surface that another one sees, {mm} from the arm, margin "
        "{allowed_mm}",
        remedy="a shiny object may be there: add a camera that sees it, or check depth scale and poses",
    ),
    Bound(
        quantity="*depth edge*, from the arm",
        why="a surface may extend one pixel past an edge without depth",
        on="class_distance",
        unit="m",
        parts=(EvidenceClass.DEPTH_EDGE,),
        say="an edge without depth is {mm} from the arm, margin {allowed_mm} (the surface may extend one pixel "
        "further)",
        remedy="keep farther from the edge, or add a camera that sees past it or has smaller pixels",
    ),
    Bound(
        quantity="*outside*, from the arm",
        why="the map ends there",
        on="class_distance",
        unit="m",
        parts=(EvidenceClass.OUTSIDE,),
        say="the workspace of the map ends {mm} from the arm, margin {allowed_mm}",
        remedy="reconstruct with a larger --box",
    ),
)
BY_FEW = {
    num: replace(
        LIMITS[0],
        quantity=f"never seen by {cameras}, of all points within the margin",
        why=f"the far side of the arm may hide a whole object from {them}",
        at_most=most,
    )
    for num, cameras, them, most in (
        (2, "two cameras", "them", UNSEEN_BY_TWO),
        (1, "a lone camera", "it", UNSEEN_BY_ONE),
    )
}
PROOF = Bound(
    quantity="not free, with `--require-proof` or `--unseen occupied`, from the arm",
    why="the verdict would rest on an assumption",
    on="class_distance",
    unit="m",
    parts=tuple(kind for kind in EvidenceClass if kind is not EvidenceClass.FREE),
    say="space not seen free within the allowed age is {mm} from the arm, margin {allowed_mm}",
    remedy="add cameras until they see every side of the arm",
)
OCCUPIED_PROOF = replace(
    PROOF,
    outcome=Outcome.FAILED,
    label=MARGIN,
    say="space that no camera saw free within the allowed age is {mm} from the arm, margin {allowed_mm} "
    "(an obstacle by --unseen occupied)",
)


def known_space(judged: Judged) -> Iterator[Reason]:
    """Every class of evidence within the margin of the arm keeps its limit (listed below).
    At most `--max-unknown` of the sphere centres are in unobserved space. A baked field needs its channel `observed`.
    """
    first = BY_FEW.get(len(judged.inputs.scene.cameras or ()), LIMITS[0])
    for limit in (first, *LIMITS[1:]):
        yield from limit(judged)
    if (is_occupied := judged.request.unseen == OCCUPIED) or judged.request.require_proof:
        if np.isnan(judged.replay.trace["assumed"]).all():
            yield not_evaluable(
                sentence="expected evidence of the space near the arm, got none",
                remedy="give a reconstruction as --scene",
            )
        yield from (OCCUPIED_PROOF if is_occupied else PROOF)(judged)
    if judged.metrics["unknown_share"] is None:
        yield not_evaluable(
            sentence="expected a record of the space that cameras saw, got none",
            remedy="give a reconstruction as --scene, or bake with the channel observed",
        )
    yield from UNKNOWN_SHARE(judged)


def _unknown_share(judged: Judged) -> Reason:
    trace, share = judged.replay.trace, judged.metrics["unknown_share"]
    first_s = trace.seconds(int(np.argmax(trace["unknown_share"] > judged.request.max_unknown)))
    return not_evaluable(sentence="", value=share, time_s=first_s, count=judged.replay.num_states)


UNKNOWN_SHARE = Bound(
    on=_unknown_share,
    at_most=attrgetter("request.max_unknown"),
    say="{percent:.1f} % of the sphere centres lie in unseen space, allowed {allowed_percent:g} %, first",
    passed="{percent:.2g} % of sphere centres in unseen space",
    remedy="add a camera, or give a larger --max-unknown",
)


def map_error(judged: Judged) -> Iterator[Reason]:
    """The surface clearance is at least the bound on the map's error; judged with `--evidence`.

    With a smaller clearance no contact was seen, but the map cannot exclude one: not evaluable, unless another
    criterion fails. The same holds for too little evidence.
    """
    measured, surface = judged.replay.map_error, lowest(judged.replay.trace["clearance_surface"])
    if measured is None and judged.request.require_evidence:
        yield not_evaluable(sentence="not measured", remedy="give --evidence a camera that did not train the map")
    if measured is not None and measured.bound is None:
        yield not_evaluable(
            sentence=f"not bounded: {measured.num_seen} of {measured.num_sets} held-out frame sets show surface near "
            "the motion, too few for two independent blocks",
            who=measured.source,
            remedy="judge a longer motion, name another camera, or raise verdict.evidence_reach",
            count=measured.num_seen,
        )
    if measured is None or measured.bound is None or surface is None:  # no distance at any state: others report it
        return
    value = measured.bound.bound
    if surface >= value:
        yield passed_reason(bound_words(measured.bound), surface - value, 0.0, "m", measured.num_points)
        return
    yield not_evaluable(
        sentence=f"{bound_words(measured.bound)}, but the clearance is only {mm(surface)}; largest residual",
        value=surface - value,
        threshold=0.0,
        unit="m",
        time_s=measured.time_s,
        place=measured.place,
        who=measured.source,
        cause="" if measured.place is None else "at ({:.2f}, {:.2f}, {:.2f}) m".format(*measured.place),
        remedy="for a smaller error, add cameras, or raise frame rate or --max-splats",
        count=measured.num_points,
    )


def bound_words(bound: ConformalBound) -> str:
    return (
        f"at most {mm(bound.bound)} with {100 * bound.confidence:.3g} % confidence from "
        f"{bound.num_blocks} blocks of held-out depth"
    )


def find_displaced(judged: Judged) -> tuple[str, float] | None:
    """The worst uncorrected displaced camera and its offset [m]; None without any."""
    rows = judged.inputs.scene.figures().get("displaced_cameras") or {}
    off = {
        camera: 1e-3 * row["distance_mm"]
        for camera, row in rows.items()
        if is_displaced(row) and not is_corrected(row)
    }
    return max(off.items(), key=lambda item: item[1], default=None)


def calibration(judged: Judged) -> Iterator[Reason]:
    """Each camera sees the robot, and all cameras each link, within 5 mm of joints."""
    figures = judged.inputs.scene.figures()
    if (camera := find_displaced(judged)) is not None:
        yield not_evaluable(
            sentence=f"{camera[0]} sees the robot {mm(camera[1])} from where its joints put it, allowed "
            f"{mm(MISPLACED)}: obstacles near it in the map may be the robot itself",
            value=camera[1],
            threshold=MISPLACED,
            unit="m",
            who=camera[0],
            remedy="find the cameras' poses ('splatctrl calibrate'), and give --calibration to reconstruct",
            count=int(figures["displaced_cameras"][camera[0]]["num_pixels"]),
        )
    cameras = figures.get("displaced_cameras") or {}
    yield from (displaced_camera(name, row) for name, row in cameras.items() if is_corrected(row))
    residual, by_link = figures.get("self_mask_residual_mm"), figures.get("self_mask")
    if residual is None or not isinstance(by_link, dict):
        return
    value = 1e-3 * float(residual)
    judged_links = {link: row for link, row in by_link.items() if row.get("is_judged", True)}
    link, worst = max(
        judged_links.items(), key=lambda row: abs(float(row[1]["median_mm"])), default=("", dict[str, Any]())
    )
    yield (
        passed_reason(f"cameras see the robot within {mm(value)} of its joints", value, MISPLACED, "m", len(by_link))
        if value <= MISPLACED
        else not_evaluable(
            sentence=f"the cameras see {link} {mm(value)} {'behind' if worst['sign'] > 0 else 'before'} where its "
            f"joints put it, allowed {mm(MISPLACED)}",
            value=value,
            threshold=MISPLACED,
            unit="m",
            who=str(link),
            remedy="calibrate the cameras ('splatctrl check'), or correct URDF, joint zeros or depth scale",
            count=int(worst["num_pixels"]),
        )
    )


def map_resolution(judged: Judged) -> Iterator[Reason]:
    """Voxels are at most 25 mm, to which an obstacle without a splat is known.
    The self-mask extends at most the margin from the robot, because it may hide an obstacle that touches the robot.
    """
    yield from VOXEL(judged)
    yield from BLIND(judged)


def _blind_link(judged: Judged) -> Reason:
    """The link whose mask reaches farthest [m]."""
    by_link = judged.inputs.scene.figures().get("self_mask") or {}
    reaches = {link: 1e-3 * row.get("reach_mm", 0.0) for link, row in by_link.items()}
    blind = max(reaches, key=reaches.__getitem__, default="")
    return not_evaluable(sentence="", value=reaches.get(blind), who=blind)


VOXEL = Bound(
    on=lambda judged: not_evaluable(sentence="", value=judged.inputs.scene.figures().get("voxel")),
    at_most=COARSE_VOXEL,
    unit="m",
    say="the map has voxels of {mm}, allowed {allowed_mm} near a robot",
    remedy="reconstruct with --urdf, or with --set scene.scale=1",
)
BLIND = Bound(
    on=_blind_link,
    at_most=attrgetter("replay.margin"),
    unit="m",
    say="surfaces within {mm} of {who} count as the robot, margin {allowed_mm}",
    remedy="lower occupancy.self_mask_tolerance or occupancy.depth_error, or place a camera nearer",
)


OF_EVIDENCE: tuple[Criterion[Judged], ...] = (
    Criterion(name="map error", find=map_error, broken=UNKNOWN),
    Criterion(
        name="evidence",
        find=attrgetter("inputs.mismatches"),
        meaning="map, log and robot match: digests, first frames, calibration, times, base, joints, links. No file "
        "was changed. Splats agree with their occupancy grid",
        broken=f"{UNKNOWN}; a changed file is refused (exit 4)",
    ),
    Criterion(name="calibration", find=calibration, broken=UNKNOWN),
    Criterion(name="map resolution", find=map_resolution, broken=UNKNOWN),
    Criterion(name="judged time", find=judged_time, broken=f"{UNKNOWN}; `--start-time first-map` judges the rest"),
    Criterion(name="known space", find=known_space, broken=f"{UNKNOWN}; failed with `--unseen occupied`"),
    Criterion(name="evidence age", find=evidence_age, broken=UNKNOWN),
    Criterion(
        name="map age",
        find=map_age,
        broken=f"{UNKNOWN}; failed (contact, margin broken) by depth of a state's own time",
    ),
    Criterion(
        name="clocks",
        find=CLOCKS,
        meaning="the offset of camera and robot clocks, less its uncertainty, is at most 50 ms",
        broken=UNKNOWN,
    ),
)
