"""A replay: read, replay, measure, judge by every criterion of *safe*, write."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np

from splatctrl_cli.calibration.displacement import correct_pose
from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.control.line_process import shown
from splatctrl_cli.control.separation import read_separation
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.verdict import (
    JudgedResult,
    Outcome,
    Reason,
    Verdict,
    check_gate_names,
    gate_reasons,
    verdict_of,
)
from splatctrl_cli.evaluate.views import frames_of
from splatctrl_cli.evaluate.worst_frames import Sight
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_json
from splatctrl_cli.formats.scene.scene_folder import MAP_DELAYS, open_scene
from splatctrl_cli.jobs.reconstruct.reconstruct import declarations_of
from splatctrl_cli.jobs.recordings.provenance import made_from_mismatches, scene_mismatches, truth_mismatch
from splatctrl_cli.jobs.replay.criteria import CONTACT, SAFE, Judged, largest_about
from splatctrl_cli.jobs.replay.evidence import (
    Evidence,
    add_agreement,
    add_truth,
    check_evidence,
    map_error,
    open_evidence,
)
from splatctrl_cli.jobs.replay.evidence_criteria import OF_EVIDENCE, bound_words, find_displaced
from splatctrl_cli.jobs.replay.files import draw_worst_frames, worst_sights, write_replay
from splatctrl_cli.jobs.replay.goal import check_controller, check_goal, check_twists
from splatctrl_cli.jobs.replay.inputs import (
    LoggedStates,
    MeasuredRobot,
    clock_of,
    doubts_of,
    grasp_contacts,
    measured_robot,
    open_log,
    read_states,
    recorded_postures,
    words_of,
)
from splatctrl_cli.jobs.replay.known_scene import KnownScene
from splatctrl_cli.jobs.replay.lockstep import check_lockstep, choose_scene
from splatctrl_cli.jobs.replay.metrics import counts_of, first_time, metric_scales, metrics_of
from splatctrl_cli.jobs.replay.modes import replayed
from splatctrl_cli.jobs.replay.motion_criteria import OF_MOTION, unlearned_link
from splatctrl_cli.jobs.replay.request import MODES, Replay, ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replay.separation import add_separation, check_separation, separation_lines
from splatctrl_cli.jobs.robot.logged_robot import NO_SELF_MODEL
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.capture.capture import ROBOT
from splatctrl_cli.robot.declared_contact import carried_words
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.truth import load_truth

REQUESTED = ("--require",)  # criteria of the request itself
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
    last = first + replay.trace.seconds(-1)
    end = f"s of the log to {past:.2f} s past its end" if past > 0 else f"to {last:.2f} s of the log"
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
    error = judged.replay.map_error
    yield (
        "map error not measured" if error is None or error.bound is None else f"map error {bound_words(error.bound)}"
    )
    if close := [name for name, (first, _) in judged.replay.statics.items() if first < judged.threshold]:
        yield f"{len(close)} fixed spheres within the margin of their surroundings are not judged"
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
    """Settings of evidence and margins laxer than their defaults."""
    usual = ReplayRequest(log=request.log, out=request.out)
    for name in (*LARGER_IS_LAXER, *SMALLER_IS_LAXER):
        value, default = (attrgetter(name)(each) for each in (request, usual))
        if value > default if name in LARGER_IS_LAXER else value < default:
            words = name.removeprefix("config.") if "." in name else f"--{name.replace('_', '-')}"
            yield f"waived: {words}" + ("" if value is True else f" {value:g} (by default {default:g})")


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
    for use in declared.carried_uses():
        if not any(use | {"num_uses": 0} == mapped | {"num_uses": 0} for mapped in of_map):
            yield (
                f"{use['link']} carries a box: warning: the map was made without this declaration; give reconstruct"
                " the same --declare"
            )


@dataclass(frozen=True, kw_only=True, repr=False)
class ReplayResult(JudgedResult):
    """Replay's result; notes: on robot, pictures and log; is_damaged: log parts were lost."""

    inputs: ReplayInputs
    replay: Replay
    is_damaged: bool

    def exit_code(self, *, report_only: bool = False) -> int:
        """1 or 5 by the verdict, 3 for a damaged log, else 0.

        With `report_only` only the request's own gates set 1 or 5.
        """
        return self.verdict.exit_code_of(REQUESTED if report_only else None) or (3 if self.is_damaged else 0)


def replay(request: ReplayRequest, progress: Progress = SILENT) -> ReplayResult:
    """Replay, and write the output folder. Raises SplatCtrlError."""
    check_request(request)
    config, stopwatch = request.config, Stopwatch()
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        motion = ImageMotion()
        with stopwatch.stage("read"):
            inputs, logged, evidence, robot = _read(request, folder, progress, motion)
        for doubt in doubts_of(request, robot, config.control):
            progress.log(f"warning: {doubt}")
        with stopwatch.stage("replay"):
            replayed_run = replayed(request, inputs, progress)
        inputs.scene.finish()
        logged = replace(logged, clock=clock_of(inputs.model, logged, motion))
        with stopwatch.stage("truth"):
            replayed_run, sights = _watch(request, inputs, replayed_run)
        if evidence is not None:
            with stopwatch.stage("evidence"):
                replayed_run = replace(
                    replayed_run, map_error=map_error(evidence, inputs, replayed_run.trace, config.verdict)
                )
        if inputs.separation is not None:
            with stopwatch.stage("separation"):
                replayed_run = add_separation(inputs.separation, inputs, replayed_run)
        metrics = metrics_of(replayed_run) | logged.metrics()
        with stopwatch.stage("verdict"):
            verdict = replay_verdict(
                Judged(request=request, inputs=inputs, logged=logged, replay=replayed_run, metrics=metrics)
            )
        with stopwatch.stage("worst_frames"):
            unseen = draw_worst_frames(folder, replayed_run, sights)
        write_json(folder / "states.json", logged.as_dict())
        of_robot = words_of(
            robot, config.control, () if replayed_run.closed_loop is None else replayed_run.closed_loop.by_surface
        )
        write_replay(
            folder,
            replayed_run,
            metrics,
            verdict,
            of_robot,
            config=config,
            inputs=inputs.digests,
            stopwatch=stopwatch,
        )
    return ReplayResult(
        out=request.out,
        inputs=inputs,
        replay=replayed_run,
        metrics=metrics,
        verdict=verdict,
        notes=(*of_robot.values(), *unseen, *logged.lines(), *separation_lines(replayed_run, metrics)),
        is_damaged=bool(inputs.source.loss.damaged),
    )


def check_request(request: ReplayRequest) -> None:
    """Raise UsageError for gates on missing figures, and options of another mode."""
    fields = ("exact", "barrier", *(("certified",) if request.field is not None else ()))
    has_truth, has_twists = request.truth is not None, request.twist_topic is not None
    has_separation = request.separation is not None
    names = {
        mode: metric_scales(mode, fields, has_truth=has_truth, has_twists=has_twists, has_separation=has_separation)
        for mode in MODES
    }
    check_gate_names(request.require, names[request.mode], {f"--mode {mode}": names[mode] for mode in names})
    check_lockstep(request)
    check_evidence(request)
    check_twists(request)
    check_goal(request)
    check_controller(request)
    check_separation(request)


def _watch(request: ReplayRequest, inputs: ReplayInputs, replay: Replay) -> tuple[Replay, list[Sight | None]]:
    off = inputs.scene.figures().get("displaced_cameras") or {}
    recorded = frames_of(inputs.source) if inputs.source.cameras else iter(())
    replay, surfaces = add_truth(inputs, replay)
    seen = (correct_pose(frame, off) for frame in recorded)
    frames = seen if surfaces is None else surfaces.watching(seen)
    sights = worst_sights(inputs, replay, request.worst_frames, frames)
    if surfaces is not None:
        for _ in frames:  # frames that no moment needs
            pass
        replay = add_agreement(replay, surfaces)
    return replay, sights


def _read(
    request: ReplayRequest, folder: Path, progress: Progress, motion: ImageMotion
) -> tuple[ReplayInputs, LoggedStates, Evidence | None, MeasuredRobot]:
    """Read the inputs; `motion` gets every frame of the log now, or during a lockstep."""
    model, opened = open_log(request, progress)
    if request.urdf is None:  # for who looks at the run
        (folder / ROBOT).write_text(model.urdf.text, encoding="utf-8", newline="")
    separation = None if request.separation is None else read_separation(request.separation, model.joint_names)
    logged = read_states(opened, model)
    robot = measured_robot(request, model, request.config.control, recorded_postures(logged.states))
    model = robot.model
    truth = None if request.truth is None else load_truth(request.truth)
    if truth is not None and (other := truth_mismatch(truth, logged.states, model)) is not None:
        raise InputError(other.sentence, remedy=other.remedy)
    declared = declarations_of(request.declare, model)
    declared = replace(declared, expected_contact=(*declared.expected_contact, *grasp_contacts(model, logged.states)))
    evidence = open_evidence(request, model)
    source = logged.source
    reads_all = request.lockstep and request.evidence not in source.cameras  # none of them is evidence
    observe = motion.add if reads_all else None
    if source.cameras and observe is None:
        for frame in frames_of(source):
            motion.add(frame)
    scene = choose_scene(request, model, declared, folder, progress, source, observe)
    robot_files = (request.urdf, request.spheres, request.self_model, request.srdf)
    files = [
        path
        for path in (*robot_files, request.truth, request.declare, request.separation)
        if path not in (None, NO_SELF_MODEL)
    ]
    inputs = ReplayInputs(
        source=source,
        states=logged.states,
        model=model,
        scene=scene,
        truth=truth,
        digests={**source.digests(), **scene.digests, **{path.name: sha256(path) for path in files}},
        mismatches=_mismatches(request, scene, logged, model),
        declared=declared,
        surfaces=robot.surfaces,
        pair_margins=robot.pair_margins,
        separation=separation,
    )
    return inputs, logged, evidence, robot


def _mismatches(
    request: ReplayRequest, known: KnownScene, logged: LoggedStates, model: RobotModel
) -> tuple[Reason, ...]:
    if request.field is not None:
        return tuple(made_from_mismatches(request.field, known.figures(), logged.source, model))
    scene = None if request.scene is None else open_scene(request.scene)
    return () if scene is None else tuple(scene_mismatches(scene, logged.source, logged.states, model))
