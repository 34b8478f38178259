"""The verdict of a replay, by every criterion of *safe*."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from operator import attrgetter

import numpy as np

from splatctrl_cli.control.line_process import shown
from splatctrl_cli.evaluate.verdict import Outcome, Verdict, gate_reasons, verdict_of
from splatctrl_cli.formats.scene.scene_folder import MAP_DELAYS
from splatctrl_cli.jobs.replay.criteria import CONTACT, SAFE, Judged, largest_about
from splatctrl_cli.jobs.replay.evidence_criteria import OF_EVIDENCE, bound_words, find_displaced
from splatctrl_cli.jobs.replay.metrics import counts_of, first_time
from splatctrl_cli.jobs.replay.motion_criteria import OF_MOTION, unlearned_link
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.robot.declared_contact import carried_words

ASKED = ("--require",)  # criteria of the request itself
LARGER_IS_LAXER = (
    *("max_unknown", "max_map_age", "max_pose_jump", "allow_disagreement", "config.control.limit_tolerance"),
    *("config.verdict.unjudged", "config.verdict.lead_in", "config.verdict.longest_interval"),
)
SMALLER_IS_LAXER = (
    *("config.verdict.confidence", "config.verdict.evidence_reach"),
    *("config.control.margin", "config.control.self_margin"),
)
BY_MAP = ("clearance", "certified clearance", "clearance of people", "static clearance", "scene hits", "map age")
BY_OUR_CONTROLLER = ("controller", "goal")  # which the map guides
CRITERIA = (*OF_MOTION, *OF_EVIDENCE)


def replay_verdict(judged: Judged) -> Verdict:
    """Judge by every criterion, then by the request's gates."""
    replay, metrics = judged.replay, judged.metrics
    reasons = [reason for criterion in CRITERIA for reason in criterion.reasons(judged)]
    if find_displaced(judged) is not None or (replay.closed_loop and unlearned_link(judged)):
        by_map = (*BY_MAP, *(() if replay.outside else BY_OUR_CONTROLLER))
        reasons = [  # what failed may be the robot itself, as an obstacle of the map
            replace(reason, outcome=Outcome.NOT_EVALUABLE, label="")
            if reason.criterion in by_map and reason.outcome is Outcome.FAILED
            else reason
            for reason in reasons
        ]
        reasons.sort(key=lambda reason: reason.criterion != "calibration")
    reasons.sort(key=lambda reason: reason.label != CONTACT)  # contact by any measure precedes a broken margin
    counts = counts_of(replay, judged.logged, metrics)
    reasons += gate_reasons(judged.request.require, metrics, counts, first_time=partial(first_time, replay))
    return verdict_of(
        "replay",
        reasons,
        scope=_scope(judged),
        passed=SAFE,
        how=_how(judged),
        notes=tuple(_notes(judged)),
        is_damaged=bool(judged.inputs.source.loss.damaged),
        counts=counts,
    )


def _scope(judged: Judged) -> str:
    replay, past = judged.replay, judged.past_end_s
    first = replay.start_time_s
    end = f"s of the log to {past:.2f} s past its end"
    if past <= 0:
        end = f"to {first + replay.trace.seconds(-1):.2f} s of the log"
    motion = "driven" if replay.closed_loop else "logged"
    who = "" if replay.outside is None else f", controller {shown(replay.outside.name)}"
    return f"{motion} motion from {first:.2f} {end}, {replay.num_states} states{who}"


def _how(judged: Judged) -> str:
    """Return "waived", "proven" (all space within the margin seen free), or an empty text."""
    if any(waivers(judged.request)):
        return "waived"
    assumed = largest_about(judged.replay.trace, "assumed")
    return "proven" if assumed is not None and assumed <= 0 else ""


def _notes(judged: Judged) -> Iterator[str]:
    found = judged.replay.map_error
    yield (
        "map error not measured" if found is None or found.bound is None else f"map error {bound_words(found.bound)}"
    )
    if close := [name for name, (first, _) in judged.replay.statics.items() if first < judged.threshold]:
        yield f"{len(close)} fixed spheres stand within the margin of their surroundings"
    if judged.replay.num_before_scene and judged.replay.lead_in_s > 0:
        yield f"{judged.replay.lead_in_s:.2f} s before the first map are left out"
    scene = judged.inputs.scene.figures()
    if (dropped := scene.get("num_dropped_sets")) is not None:
        late, latest = np.median(scene[MAP_DELAYS]), max(scene[MAP_DELAYS])
        num = f"{dropped} of {dropped + scene['time_steps']} frame sets were dropped"
        yield f"in real time {num}; maps were {late:.2f} s late in the median, {latest:.2f} s at most"
    unseen, assumed = (largest_about(judged.replay.trace, name) for name in ("unseen", "assumed"))
    if unseen is None:
        yield "space about the arm not judged"
    if assumed is not None and assumed > 0:
        yield f"at most {100 * assumed:.0f} % of the space within the margin of the arm was assumed to be free"
    if largest_about(judged.replay.trace, "evidence_age") is None:
        yield "age of the evidence about the arm not judged"
    yield from _declared_notes(judged)
    yield from waivers(judged.request)
    if inside := judged.inputs.scene.figures().get("inside_robot_points"):
        yield f"{inside} measured points lie inside the robot: contact, a carried object, or calibration"
    if judged.request.re_anchor is not None:
        yield "the arm is reset to the log's configuration on the way: motion between states is not judged"


def waivers(request: ReplayRequest) -> Iterator[str]:
    """Options and settings of evidence and margins laxer than their defaults."""
    usual = ReplayRequest(log=request.log, out=request.out)
    for name in (*LARGER_IS_LAXER, *SMALLER_IS_LAXER):
        given, default = (attrgetter(name)(each) for each in (request, usual))
        if given > default if name in LARGER_IS_LAXER else given < default:
            words = name.removeprefix("config.") if "." in name else f"--{name.replace('_', '-')}"
            yield f"waived: {words}" + ("" if given is True else f" {given:g} (by default {default:g})")


def _declared_notes(judged: Judged) -> Iterator[str]:
    declared, inputs = judged.inputs.declared, judged.inputs
    if inputs.model.self_model is not None:
        yield from (part.words(int(inputs.states.stamp_ns[0])) for part in inputs.model.self_model.parts)
    for index, entry in enumerate(declared.expected_contact):
        num = declared.num_uses.get(("expected_contact", index), 0)
        if entry.is_learned and not num:
            continue
        used = f"{num} times" if num else "warning: not used by any state; check its links and times, or leave it out"
        how = "meant" if entry.is_learned else "declared"
        yield f"contact of {entry.link} {how} ({entry.reason}): {used}"
    of_map = judged.inputs.scene.figures().get("carried", [])
    yield from map(carried_words, of_map)
    for given in declared.carried_uses():
        if not any(given | {"num_uses": 0} == made | {"num_uses": 0} for made in of_map):
            yield (
                f"{given['link']} carries a box: warning: the map was made without this declaration; give reconstruct"
                " the same --declare"
            )
