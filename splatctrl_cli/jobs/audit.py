"""An audit: steps in one folder, from a recording to a verdict and one page."""

import hashlib
import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError, UsageError, WriteError, refuse_faults, refuse_if
from splatctrl_cli.evaluate.verdict import JudgedResult, Verdict, not_evaluable, read_verdict, verdict_of, worst
from splatctrl_cli.files.output import (
    Stopwatch,
    recorded_as,
    sha256,
    write_durably,
    write_json,
    write_run,
)
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.jobs.check import CheckRequest, check
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.jobs.render import render_newest
from splatctrl_cli.jobs.replay.replay import check_request, replay
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.report.report import write_page_of_runs
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions, installed_urdf, logged_urdf
from splatctrl_cli.jobs.running.device import RunOptions, deciding_versions
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.runs.run_folder import open_run, read_object
from splatctrl_cli.recording.log.stored_frame import FrameSource
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.report.page import Table, compared
from splatctrl_cli.robot.link_meshes import mesh_path
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf, visual_urdf

PAIR = "the last photo on the left, the map's render on the right; drag the photo's lower corner"
WIDTH = 640  # of the views [px]
STEPS, RUN = "steps.json", "run.json"
CHECK, PAGE = "check.json", "report.html"
SCENE, LOGGED, DRIVEN = "scene", "replay", "closed_loop"
FINDING = ("severity", "code", "where", "what", "remedy")  # columns
OF_REPLAYS = ("field", "control", "planner", "verdict")  # sections of the configuration that decide no map
TITLES = {LOGGED: "Logged motion", DRIVEN: "Driven motion", SCENE: "Map"}  # of the page, by folder


@dataclass(frozen=True, kw_only=True)
class AuditRequest(RobotOptions, RunOptions):
    """An audit of `log`, read with `options`, into the folder `out`.

    urdf: the robot's file; robot: name of an installed one (`installed_urdf`). Without both, the log's robot. goal
    (x, y, z, qx, qy, qz, qw in world) or goal_joints [rad] adds a closed loop that drives the link `frame`. force:
    repeat all steps. resume: continue an interrupted reconstruction. words: options that the steps share, for their
    ``run.json``.
    """

    log: Path
    out: Path = Path("audit")
    options: SourceOptions = field(default_factory=SourceOptions)
    urdf: Path | None = None
    robot: str | None = None
    goal: tuple[float, ...] | None = None
    goal_joints: tuple[float, ...] | None = None
    frame: str | None = None
    resume: bool = False
    words: tuple[str, ...] = ()


@dataclass(kw_only=True)
class _Steps:
    """Steps in `folder`; done: digests of inputs and output by step."""

    folder: Path
    inputs: Mapping[str, object]
    done: dict[str, list[str]]
    progress: Progress
    stopwatch: Stopwatch = field(default_factory=Stopwatch)

    def make(
        self, name: str, file: str, write: Callable[[], object], words: Sequence[str] = (), **more: object
    ) -> None:
        """Write `file`, unless the same inputs already made it.

        words: the equivalent command line.
        """
        decides, path = json.dumps([self.inputs, more], sort_keys=True, default=str), self.folder / file
        key = hashlib.sha256(decides.encode()).hexdigest()
        if path.is_file() and self.done.get(name) == [key, sha256(path)]:
            self.progress.log(f"{name}: as before, {path}")
            return
        self.progress.log(f"$ splatctrl {shlex.join(words)}" if words else name)
        with self.stopwatch.stage(name), recorded_as(words):
            write()
        self.done[name] = [key, sha256(path)]
        write_durably(self.folder / STEPS, lambda partial: write_json(partial, self.done))


def audit(request: AuditRequest, progress: Progress = SILENT) -> JudgedResult:
    """Check, reconstruct, replay and write the page; skip steps that the same inputs made.

    A log without joint states is not evaluable: only its check and map are made. Document: the page, and the steps
    made now. Raises UsageError for an unknown robot, WriteError for an unwritable page, and errors of the steps.
    """
    source = open_source(request.log, request.options)
    if request.robot is not None:
        request = replace(request, urdf=installed_urdf(request.robot))
    urdf = logged_urdf([request.log]) if request.urdf is None else read_urdf(request.urdf)
    refuse_if(
        source.joint_names and urdf is None,
        f"audit: {request.log} does not describe the robot",
        remedy="give it with --urdf FILE or --robot NAME",
        error=UsageError,
    )
    digests = {**source.digests(), **_digests(request, urdf)}
    replays = _replays(request) if source.joint_names else {}
    for each in replays.values():
        check_request(each)
    options = repr((request.options, request.base, request.locked))
    inputs = {"sha256": digests, "versions": deciding_versions(), "options": options}
    steps = _Steps(folder=request.out, inputs=inputs, done=_open_folder(request), progress=progress)
    steps.make("check", CHECK, partial(_check, request))
    config, seed = request.config.as_dict(), request.seed
    of_map = {name: config[name] for name in config if name not in OF_REPLAYS}
    words = ["reconstruct", *_words(request, SCENE)]
    steps.make(SCENE, f"{SCENE}/{RUN}", partial(_reconstruct, request, progress), words, config=of_map, seed=seed)
    decides = {"config": config, "seed": seed, "map": open_run(request.out / SCENE).run.get("parts")}
    for name, each in replays.items():
        goal = _goal(each)
        words = ["replay", *_words(request, name), "--scene", str(request.out / SCENE), *goal]
        steps.make(name, f"{name}/{RUN}", partial(replay, each, progress), words, **decides, goal=goal)
    verdicts = [read_verdict(open_run(each.out).verdict) for each in replays.values()]
    verdict = worst(verdicts) if verdicts else _judge_map(request)
    shown = {name: sha256(request.out / name / RUN) for name in (*replays, SCENE)}
    steps.make("report", PAGE, partial(_write_page, request, source, verdict, [*shown]), shown=shown)
    write_run(
        request.out,
        command="audit",
        config=config,
        inputs=digests,
        metrics={},
        stopwatch=steps.stopwatch,
        seed=seed,
        verdict=verdict.as_dict(),
    )
    document = {"out": request.out, "page": request.out / PAGE, "made": [*steps.stopwatch.seconds]}
    return JudgedResult(out=request.out, document=document, verdict=verdict)


def _digests(request: AuditRequest, urdf: UrdfFile | None) -> dict[str, str]:
    digests = {} if request.spheres is None else {request.spheres.name: sha256(request.spheres)}
    if urdf is None:
        return digests
    digests["robot"] = hashlib.sha256(urdf.text.encode()).hexdigest()
    for mesh in (*urdf.meshes, *visual_urdf(urdf).meshes):
        with suppress(InputError):
            digests[mesh.filename] = sha256(mesh_path(urdf.path, mesh, request.packages))
    return digests


def _replays(request: AuditRequest) -> dict[str, ReplayRequest]:
    """Replays by folder; a driven motion only with a goal."""
    logged = ReplayRequest(
        log=request.log,
        options=request.options,
        **_robot(request),
        scene=request.out / SCENE,
        out=request.out / LOGGED,
        config=request.config,
        seed=request.seed,
        threads=request.threads,
        device=request.device,
        force=True,
    )
    if request.goal is None and request.goal_joints is None:
        return {LOGGED: logged}
    driven = replace(
        logged,
        mode="closed-loop",
        start_time="first-map",
        goal=request.goal,
        goal_joints=request.goal_joints,
        frame=request.frame,
        out=request.out / DRIVEN,
    )
    return {LOGGED: logged, DRIVEN: driven}


def _robot(request: AuditRequest) -> dict[str, Any]:
    return {name: getattr(request, name) for name in ("urdf", *(each.name for each in fields(RobotOptions)))}


def _words(request: AuditRequest, folder: str) -> list[str]:
    robot = {"--urdf": request.urdf, "--spheres": request.spheres}
    robot_words = [word for name, path in robot.items() if path is not None for word in (name, str(path))]
    return [str(request.log), *robot_words, "-o", str(request.out / folder), *request.words]


def _goal(request: ReplayRequest) -> list[str]:
    goals = {"--goal": request.goal, "--goal-joints": request.goal_joints}
    goal_words = [f"{name}={','.join(map(str, goal))}" for name, goal in goals.items() if goal is not None]
    frame = [] if request.frame is None else ["--frame", request.frame]
    return (
        ["--mode", request.mode, "--start-time", str(request.start_time), *goal_words, *frame] if goal_words else []
    )


def _open_folder(request: AuditRequest) -> dict[str, list[str]]:
    out, file, other = request.out, request.out / STEPS, "give another --out"
    with refuse_faults(
        lambda error: f"{out}: cannot be written: {error.strerror}", OSError, remedy=other, error=UsageError
    ):
        out.mkdir(parents=True, exist_ok=True)
        refuse_if(
            any(out.iterdir()) and not file.is_file(),
            f"{out}: was not written by splatctrl audit (no {STEPS})",
            remedy=other,
            error=UsageError,
        )
        if request.force or not file.is_file():
            write_json(file, {})
    return read_object(file)


def _check(request: AuditRequest) -> None:
    report, verdict = check(CheckRequest(paths=(request.log,), options=request.options, **_robot(request)))
    document = {"verdict": verdict.as_dict(), **report.as_dict()}
    write_durably(request.out / CHECK, lambda partial: write_json(partial, document))


def _reconstruct(request: AuditRequest, progress: Progress) -> None:
    reconstruct(
        ReconstructRequest(
            source=open_to_train(RecordingRequest(path=request.log, options=request.options)),
            recording=request.log,
            **_robot(request),
            out=request.out / SCENE,
            config=request.config,
            seed=request.seed,
            threads=request.threads,
            device=request.device,
            force=True,
            resume=request.resume,
            options={"input": repr((request.options, request.base, request.locked))},
        ),
        progress,
    )


def _judge_map(request: AuditRequest) -> Verdict:
    checked, mapped = read_object(request.out / CHECK)["verdict"], open_run(request.out / SCENE).verdict
    missing = not_evaluable(
        criterion="joint states",
        sentence=f"{request.log.name} has none, so no motion is judged, only the recording (check: "
        f"{checked['label']}) and its map (reconstruct: {mapped['label']}, {mapped['scope']})",
        remedy="record /joint_states",
    )
    return verdict_of("audit", [missing], scope=request.log.name, is_damaged=mapped["is_damaged"])


def _write_page(request: AuditRequest, source: FrameSource, verdict: Verdict, folders: Sequence[str]) -> None:
    page, checked = request.out / PAGE, read_object(request.out / CHECK)
    rows = [
        (tuple(finding[name] for name in FINDING), "failed" if finding["severity"] == "error" else "")
        for finding in checked["findings"]
    ]
    recording = Table(title=checked["verdict"]["sentence"], header=FINDING, rows=rows, is_folded=True)
    pairs = render_newest(open_scene(request.out / SCENE), source, request.threads)
    views = [compared(frame.color, image, f"{frame.camera}: {PAIR}", WIDTH) for frame, image in pairs]
    try:
        write_page_of_runs(
            page,
            title=f"audit of {'/'.join(request.log.parts[-2:])}",
            verdict=verdict,
            runs={TITLES[name]: open_run(request.out / name) for name in folders},
            tables=[recording],
            views=views,
        )
    except UsageError as error:  # all else is done
        raise WriteError(error.message, remedy=f"move {page} away, and run the same command") from None
