"""Check of a recording for faults, and its conversion into a capture."""

import json
import statistics
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from pathlib import Path

from splatctrl_cli import __version__
from splatctrl_cli.checks.check_folder import check_folder
from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.checks.finding import CHECKS, CheckReport, Finding, Severity, error, note, warning
from splatctrl_cli.checks.limits import VIEWS_RANGE
from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Result, Verdict, verdict_of
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_run
from splatctrl_cli.jobs.robot.logged_robot import TAKE, RobotOptions, differs, logged_urdf
from splatctrl_cli.jobs.running.device import advise_resumption, check_same_run
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.capture.capture_writer import JOURNAL, read_identity, write_capture
from splatctrl_cli.recording.folder.folder_views import HOLDOUT
from splatctrl_cli.recording.source import logged_descriptions, open_logs, open_session
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import own_spheres
from splatctrl_cli.robot.urdf import read_urdf
from splatctrl_cli.scene.recording_consistency import CAUSES, agreements

_ALLOWING = {  # options that accept an error
    **dict.fromkeys(("agreement", "views-agreement", "views-scale", "alignment"), "--allow-disagreement"),
    "pose-jump": "--max-pose-jump",
}


@dataclass(frozen=True, kw_only=True)
class SessionRequest:
    """A job on a recording; several `paths` only for logs of one session."""

    paths: tuple[Path, ...]
    options: SourceOptions = field(default_factory=SourceOptions)


@dataclass(frozen=True, kw_only=True)
class CheckRequest(SessionRequest, RobotOptions):
    """Check of a recording.

    num_images: images per topic, None for all. urdf: robot to compare with; if only `spheres` is given, the log's.
    fail_on: least severity that fails: "error", "warning" or "never".
    """

    num_images: int | None = None
    urdf: Path | None = None
    fail_on: str = "error"


def check(request: CheckRequest) -> tuple[CheckReport, Verdict]:
    """Check the recording, reading it once, and judge the findings.

    Raises UsageError for contradictory options, InputError for an unreadable recording.
    """
    refuse_if(
        request.num_images is not None and request.num_images < 1,
        f"--quick {request.num_images}: expected 1 or more",
        error=UsageError,
    )
    model = pose_robot(request.paths, request.urdf, request)
    other = "" if request.urdf is None or model is None else differs(model.urdf, request.paths)
    report = _report(request, model)
    report = replace(
        report,
        findings=[*report.findings, *([warning("robot-model", str(request.urdf), other, TAKE)] if other else [])],
    )
    return report, _verdict(report, request.fail_on)


def refuse_errors(path: Path, options: SourceOptions, allowed: Collection[str] = ()) -> None:
    """Raise InputError if `check` finds an error that blocks reconstruct, except `allowed` codes."""
    report = _report(CheckRequest(paths=(path,), options=options), None, only_errors=True)
    if errors := [f for f in report.blockers("reconstruct") if f.code not in allowed]:
        first, more = errors[0], f"; {len(errors) - 1} more: splatctrl check {path}" if len(errors) > 1 else ""
        remedy = first.remedy or CHECKS[first.code].remedy
        remedy += f"; if it is right, give {_ALLOWING[first.code]}" if first.code in _ALLOWING else ""
        raise InputError(f"{path}: {first.where}: {first.what} [{first.code}]", remedy=f"{remedy}{more}")


def _report(request: CheckRequest, model: RobotModel | None, *, only_errors: bool = False) -> CheckReport:
    log, options, num = open_logs(request.paths), request.options, request.num_images
    report = (
        check_folder(request.paths[0], options, model=model, num_images=num, only_errors=only_errors)
        if log is None
        else check_log(log, options, model=model, num_images=num, only_errors=only_errors)
    )
    return replace(report, findings=[*report.findings, *_agreement(report)])


def pose_robot(paths: Sequence[Path], urdf: Path | None, options: RobotOptions) -> RobotModel | None:
    """Robot of `urdf`, or if only spheres are given, of the recording; None without either.

    Raises UsageError for robot options without a robot.
    """
    file = None if urdf is None else read_urdf(urdf)
    if file is None and options.spheres is not None:  # without spheres it is often unusable
        file = logged_urdf(paths)
    if file is None:
        options.refuse_without_robot()
        return None
    return options.posed(file, own_spheres(file))


def _agreement(report: CheckReport) -> Iterator[Finding]:
    good: list[float] = []
    for pair in agreements(list(report.frames), *VIEWS_RANGE):
        both = list(dict.fromkeys(pair.cameras))
        if pair.holds:
            good.append(pair.median)
            continue
        text = (
            f"depths differ by {1e3 * pair.median:.1f} mm (median of {pair.num_pixels} pixels that two views see); "
            f"expected at most {1e3 * pair.limit:.0f} mm"
        )
        remedy = f"{CAUSES}: calibrate the cameras' poses again (splatctrl calibrate), or widen the range of depth"
        value = round(1e3 * pair.median, 2)
        if len(both) > 1:
            remedy += f", or keep one with --cameras {both[0]}"
            yield error("agreement", f"cameras {both[0]} and {both[1]}", text, remedy, value=value, unit="mm")
        else:
            remedy += ": is it the pose of another frame?"
            yield error("views-agreement", f"camera {both[0]}", text, remedy, value=value, unit="mm")
    if good:
        text = f"depths of one surface differ by {1e3 * max(good):.1f} mm between views (median of its pixels)"
        if len(good) > 1:
            middle = 1e3 * statistics.median(good)
            text = f"{text} in the worst of {len(good)} pairs of views, and by {middle:.1f} mm in the median pair"
        yield note("agreement", "cameras", text, value=round(1e3 * max(good), 2), unit="mm")


def _verdict(report: CheckReport, fail_on: str) -> Verdict:
    fatal = {Severity.ERROR, *([Severity.WARNING] if fail_on == Severity.WARNING else [])}
    read = Reason(
        criterion="messages",
        outcome=Outcome.PASSED if report.num_messages else Outcome.NOT_EVALUABLE,
        sentence=f"{report.num_messages} {report.unit} read",
        value=float(report.num_messages),
        threshold=1.0,
        count=report.num_messages,
    )
    reasons = [
        Reason(
            criterion=finding.code,
            outcome=Outcome.FAILED if finding.severity in fatal else Outcome.PASSED,
            sentence=f"{finding.where}: {finding.what}",
            value=finding.value,
            unit=finding.unit,
            time_s=report.seconds(finding),
            who=finding.where,
            remedy=finding.remedy,
            is_note=finding.severity is Severity.WARNING,
        )
        for finding in report.sorted_findings
    ]
    counts = ", ".join(f"{n} {name}{'' if n == 1 else 's'}" for name, n in report.counts.items())
    return verdict_of(
        "check",
        [read, *reasons],
        scope=f"{Path(report.path).name}: {counts}",
        is_damaged=any(finding.code == "damaged" for finding in report.findings),
        counts={"messages": report.num_messages},
    )


DECIDING_PACKAGES = ("numpy", "opencv-python-headless")  # whose versions may change a byte of a capture


@dataclass(frozen=True, kw_only=True)
class IngestRequest(SessionRequest):
    """Recording to write as a capture; out: None for NAME.capture, by the first path."""

    out: Path | None = None
    force: bool = False
    resume: bool = False


def ingest(request: IngestRequest, progress: Progress = SILENT) -> Result:
    """Write the capture, or continue an interrupted one to the same bytes.

    Raises UsageError without a camera or for another interrupted run, InputError for an unusable recording.
    """
    stopwatch, options = Stopwatch(), request.options
    out = request.out or Path(request.paths[0].stem + ".capture")
    with stopwatch.stage("survey"):
        source = open_session(request.paths, options)
        topics = source.joint_topics if isinstance(source, LOGGED) else None
    refuse_if(
        set(source.cameras) == {HOLDOUT},
        f"--cameras {','.join(options.cameras or ())}: leaves no camera to train with",
        remedy="name another, or leave it out",
        error=UsageError,
    )
    robots = logged_descriptions(request.paths)
    if len(robots) > 1:
        places = ", ".join(where for _, where, _ in robots)
        progress.log(
            f"warning: {len(robots)} robots are described, by {places}: none is stored; give --urdf to each command"
        )
    progress.log(f"{source.name}: cameras {', '.join(source.cameras)}; {len(source.joint_names)} joints")
    inputs = dict(source.digests())
    versions = {"splatctrl": __version__, **{name: metadata.version(name) for name in DECIDING_PACKAGES}}
    identity = json.loads(json.dumps({**versions, "options": asdict(options), "sha256": inputs}, default=str))
    journal = partial_path(out) / JOURNAL
    with (
        advise_resumption(journal, journal.parent),
        output_path(out, force=request.force, is_folder=True, checkpoint=JOURNAL, resume=request.resume) as partial,
    ):
        if (before := read_identity(partial)) is not None:
            check_same_run(partial, before, identity)
        with stopwatch.stage("write"):
            metrics, num_resumed = write_capture(
                partial,
                source,
                topics=topics,
                robot=robots[0][2] if len(robots) == 1 else "",
                progress=lambda num: progress.log(f"{num} frames") if num % 100 == 0 else None,
                identity=identity,
            )
        if num_resumed:
            progress.log(f"{num_resumed} frames were there already")
        write_run(
            partial,
            command="ingest",
            config=asdict(options),
            inputs=inputs,
            metrics=metrics,
            stopwatch=stopwatch,
        )
    return Result(out=out, metrics=metrics, document={"capture": out, **metrics})
