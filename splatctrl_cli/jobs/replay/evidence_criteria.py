"""Criteria of the evidence behind a replay's verdict."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
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
from splatctrl_cli.evaluate.verdict import Criterion, Reason, failed, lacking, passed_reason
from splatctrl_cli.jobs.reconstruct.verdict import displaced_camera
from splatctrl_cli.jobs.replay.criteria import (
    MARGIN,
    UNKNOWN,
    Judged,
    clocks,
    evidence_age,
    judged_time,
    map_age,
    mm,
    nearby,
)
from splatctrl_cli.jobs.replay.request import OCCUPIED
from splatctrl_cli.jobs.replay.trace import Trace
from splatctrl_cli.records import Float64
from splatctrl_cli.voxels import EvidenceClass


@dataclass(frozen=True, kw_only=True)
class Limit:
    """A row of the evidence table; column: of `NEAR_COLUMNS`, for `parts` the least.

    most: largest share allowed; least [m]: distance to exceed (0: the margin). For the documentation, asked: the
    quantity; why: the reason.
    """

    asked: str
    why: str
    column: str
    parts: tuple[EvidenceClass, ...] = ()
    most: float | None = None
    least: float = 0.0
    words: str
    remedy: str

    @property
    def name(self) -> str:
        return self.parts[0].name.lower() if self.parts else self.column

    def values(self, near: Trace) -> Float64:
        """The limited column (T,); NaN where space about the arm was not evaluated."""
        values: Float64 = near[self.column]
        return values[:, self.parts].min(axis=1) if self.parts else values

    def is_broken(self, near: Trace, margin: float) -> bool:
        """True if any state breaks it; margin [m]."""
        values = self.values(near)
        return bool(np.any(values <= (self.least or margin)) if self.most is None else np.any(values > self.most))

    @property
    def docs(self) -> str:
        """Row of the documentation's table, its cells separated by |."""
        within = f"at most {100 * self.most:g} %" if self.most is not None else ""
        distance = f"more than {1e3 * self.least:g} mm" if self.least else "more than the margin"
        return f"{self.asked} | {within or distance} | {self.why}"


LIMITS = (
    Limit(
        asked="never seen, of all points within the margin",
        why="correct recordings of three cameras leave up to 49 %; what this limit alone rejects leaves 50 % or more",
        column="unseen",
        most=UNSEEN,
        words="of the space within the margin of the arm was never seen",
        remedy="add a camera that sees where the arm goes",
    ),
    Limit(
        asked="path from a surface of the map to the arm, by a point never seen",
        why="an object may extend into space on its unseen side",
        column="unseen_path",
        least=UNSEEN_PATH,
        words="a surface of the map is {} from the arm by a path over unseen space, allowed {allowed}: it may extend "
        "there",
        remedy="add a camera that sees that side",
    ),
    Limit(
        asked="never seen, as nine tenths of the points about a sphere of the arm, from a surface of the map",
        why="space that is almost entirely unseen may hold a whole object",
        column="blind_to_surface",
        least=BEYOND,
        words="a part of the arm enters space that is over 90 % unseen, {} from a surface of the map, allowed "
        "{allowed}: the surface may extend there",
        remedy="add a camera that sees where the arm goes",
    ),
    Limit(
        asked="unanswered, from the arm",
        why="a dark, shiny or transparent object returns no depth where depth is expected",
        column="class_distance",
        parts=(EvidenceClass.UNANSWERED,),
        words="cameras got no depth from a place {} from the arm, margin {allowed}",
        remedy="a dark, shiny or transparent object may be there: add a camera that gets depth there",
    ),
    Limit(
        asked="contradicted, from the arm",
        why="depth of a shiny object may lie far behind it",
        column="class_distance",
        parts=(EvidenceClass.CONTRADICTED,),
        words="{} from the arm, margin {allowed}, one camera measures depth behind a surface that another one sees",
        remedy="a shiny object may be there: add a camera that sees it, or check depth scale and poses",
    ),
    Limit(
        asked="depth edge, from the arm",
        why="a surface may extend one pixel past an edge without depth",
        column="class_distance",
        parts=(EvidenceClass.DEPTH_EDGE,),
        words="a depth edge was lost {} from the arm, margin {allowed}: the surface may extend one pixel further",
        remedy="keep farther from the edge, or add a camera that sees past it, or one with smaller pixels",
    ),
    Limit(
        asked="outside of the workspace, from the arm",
        why="the map ends there",
        column="class_distance",
        parts=(EvidenceClass.OUTSIDE,),
        words="the workspace of the map ends {} from the arm, margin {allowed}",
        remedy="reconstruct with a larger --box",
    ),
)
BY_FEW = {
    num: replace(
        LIMITS[0],
        asked=f"never seen by {cameras}, of all points within the margin",
        why=f"the far side of the arm may hide a whole object from {them}",
        most=most,
    )
    for num, cameras, them, most in (
        (2, "two cameras", "them", UNSEEN_BY_TWO),
        (1, "a lone camera", "it", UNSEEN_BY_ONE),
    )
}
PROOF = Limit(
    asked="not free, with `--require-proof` or `--unseen occupied`, from the arm",
    why="such a run would be safe by assumption",
    column="class_distance",
    parts=tuple(kind for kind in EvidenceClass if kind is not EvidenceClass.FREE),
    words="space not seen free within the allowed age is {} from the arm, margin {allowed}",
    remedy="add cameras until they see every side of the arm",
)


def known_space(judged: Judged) -> Iterator[Reason]:
    """Every class of evidence within the margin of the arm keeps its limit (listed below); at most `--max-unknown`
    of the sphere centres are in unobserved space. A baked field needs its channel `observed`.
    """
    first = BY_FEW.get(len(judged.inputs.scene.cameras or ()), LIMITS[0])
    for limit in (first, *LIMITS[1:]):
        yield from _check_limit(judged, limit)
    if judged.request.unseen == OCCUPIED:
        yield from _check_limit(judged, PROOF, partial(failed, label=MARGIN))
    elif judged.request.require_proof:
        yield from _check_limit(judged, PROOF)
    yield from _unknown_share(judged)


def _check_limit(judged: Judged, limit: Limit, broken: Callable[..., Reason] = lacking) -> Iterator[Reason]:
    near = judged.replay.trace
    values = limit.values(near)
    if limit is PROOF and np.isnan(near["assumed"]).all():
        yield lacking(sentence="evidence of the space near the arm is not recorded")
    if limit.most is not None:
        worst = nearby(near, limit.column)
        if worst is None:
            return
        words = f"{100 * worst[0]:.0f} % {limit.words}"
        if not limit.is_broken(near, judged.replay.margin):
            yield passed_reason(words, worst[0], limit.most, "", worst[2])
            return
        yield broken(
            sentence=f"{words}, allowed {100 * limit.most:g} %",
            value=worst[0],
            threshold=limit.most,
            time_s=worst[1],
            remedy=limit.remedy,
            count=worst[2],
        )
        return
    if not limit.is_broken(near, judged.replay.margin):
        return
    at, allowed = int(np.nanargmin(values)), limit.least or judged.replay.margin
    if limit.parts:
        nearest = min(limit.parts, key=lambda kind: float(near["class_distance"][at, kind]))
        place = near["class_places"].reshape(len(values), -1, 3)[at, nearest]
    else:
        place = near[f"{limit.column}_place"][at]
    yield broken(
        sentence=limit.words.format(mm(values[at]), allowed=mm(allowed)),
        value=float(values[at]),
        threshold=allowed,
        unit="m",
        time_s=judged.replay.trace.seconds(at),
        place=tuple(place.tolist()),
        cause="at ({:.2f}, {:.2f}, {:.2f}) m".format(*place),
        remedy=limit.remedy,
        count=int((values <= allowed).sum()),
    )


def _unknown_share(judged: Judged) -> Iterator[Reason]:
    share, allowed = judged.metrics["unknown_share"], judged.request.max_unknown
    if share is None:
        yield lacking(sentence="the space that cameras saw is not recorded")
    elif share <= allowed:
        yield passed_reason(
            f"{100 * share:.2g} % of sphere centres in unseen space", share, allowed, "", judged.replay.num_states
        )
    else:
        at = int(np.argmax(judged.replay.trace["unknown_share"] > allowed))
        yield lacking(
            sentence=f"{100 * share:.1f} % of the sphere centres lie in unseen space, allowed {100 * allowed:g} %, "
            "first",
            value=share,
            threshold=allowed,
            time_s=judged.replay.trace.seconds(at),
            remedy="add a camera, or give a larger --max-unknown",
            count=judged.replay.num_states,
        )


def map_error(judged: Judged) -> Iterator[Reason]:
    """The surface clearance less the bound on the map's error is at least 0; judged with `--evidence`.

    With a smaller clearance no contact was seen, but the map cannot exclude one: not evaluable, unless another
    criterion fails. The same holds for too little evidence.
    """
    found, surface = judged.replay.map_error, lowest(judged.replay.trace["clearance_surface"])
    if found is None and judged.request.require_evidence:
        yield lacking(sentence="not measured", remedy="give --evidence a camera that did not train the map")
    if found is not None and found.bound is None:
        yield lacking(
            sentence=f"not bounded: of {found.num_sets} held-out frame sets in the judged time {found.num_seen} show "
            "surface near the motion, too few for two independent stretches",
            who=found.source,
            remedy="judge a longer motion, or name another camera; verdict.evidence_reach says how near",
            count=found.num_seen,
        )
    if found is None or found.bound is None or surface is None:  # no distance at any state: others report it
        return
    value = found.bound.bound
    if surface >= value:
        yield passed_reason(bound_words(found.bound), surface - value, 0.0, "m", found.num_points)
        return
    yield lacking(
        sentence=f"the map may miss surface by {mm(value)} ({bound_words(found.bound)}), but the motion keeps only "
        f"{mm(surface)}; it missed most",
        value=surface - value,
        threshold=0.0,
        unit="m",
        time_s=found.time_s,
        place=found.place,
        who=found.source,
        cause="" if found.place is None else "at ({:.2f}, {:.2f}, {:.2f}) m".format(*found.place),
        remedy="a map that misses less needs more cameras, newer frames or a larger --max-splats",
        count=found.num_points,
    )


def bound_words(bound: ConformalBound) -> str:
    return (
        f"map error at most {mm(bound.bound)} with {100 * bound.confidence:.3g} % confidence from "
        f"{bound.num_stretches} stretches of held-out depth"
    )


def belonging(judged: Judged) -> Iterator[Reason]:
    """Scene, log and robot belong together: digests, first frames, calibration, times, joints, links; files as
    written; splats that agree with their occupancy grid.
    """
    yield from judged.inputs.mismatches


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
    """Each camera sees the robot, all cameras each link, within 5 mm of the joints."""
    figures = judged.inputs.scene.figures()
    if (camera := find_displaced(judged)) is not None:
        yield lacking(
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
        passed_reason(f"the robot is seen within {mm(value)}", value, MISPLACED, "m", len(by_link))
        if value <= MISPLACED
        else lacking(
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
    """Voxels are at most 25 mm, the size of an obstacle without a splat. The robot's mask reaches at most
    the margin: an obstacle touching the robot may go unseen that far.
    """
    figures, margin = judged.inputs.scene.figures(), judged.replay.margin
    voxel, by_link = figures.get("voxel"), figures.get("self_mask")
    if voxel is not None and voxel > COARSE_VOXEL:
        yield lacking(
            sentence=f"the map has voxels of {mm(voxel)}, allowed {mm(COARSE_VOXEL)} beside a robot",
            value=float(voxel),
            threshold=COARSE_VOXEL,
            unit="m",
            remedy="reconstruct with --urdf, or with --set scene.scale=1",
        )
    reaches = {link: 1e-3 * row.get("reach_mm", 0.0) for link, row in (by_link or {}).items()}
    blind = max(reaches, key=reaches.__getitem__, default=None)
    if blind is not None and reaches[blind] > margin:
        yield lacking(
            sentence=f"surfaces within {mm(reaches[blind])} of {blind} count as the robot, margin {mm(margin)}",
            value=reaches[blind],
            threshold=margin,
            unit="m",
            who=blind,
            remedy="lower occupancy.self_mask_tolerance or occupancy.depth_error, or place a camera nearer",
        )


OF_EVIDENCE: tuple[Criterion[Judged], ...] = (
    Criterion(name="map error", find=map_error, broken=UNKNOWN),
    Criterion(name="evidence", find=belonging, broken=f"{UNKNOWN}; a changed file is refused (exit 4)"),
    Criterion(name="calibration", find=calibration, broken=UNKNOWN),
    Criterion(name="map resolution", find=map_resolution, broken=UNKNOWN),
    Criterion(name="judged time", find=judged_time, broken=f"{UNKNOWN}; `--start-time first-map` judges the rest"),
    Criterion(name="known space", find=known_space, broken=UNKNOWN),
    Criterion(name="evidence age", find=evidence_age, broken=UNKNOWN),
    Criterion(name="map age", find=map_age, broken=f"{UNKNOWN}; *contact* or *margin broken* by its own depth"),
    Criterion(name="clocks", find=clocks, broken=UNKNOWN),
)
