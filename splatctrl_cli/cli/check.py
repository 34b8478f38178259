"""``splatctrl check``: what is wrong with a recording, before it costs an hour."""

import argparse
import statistics
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.checks.check_source import check_source
from splatctrl_cli.checks.finding import CheckReport, Finding, Rate, Severity, error, note
from splatctrl_cli.cli.common import Console, Subparsers, add_command, table
from splatctrl_cli.cli.numbers import several
from splatctrl_cli.cli.robot_options import add_lock, locked_joints
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.consistency import CAUSES, agreements
from splatctrl_cli.sources.source import open_logs

QUICK = 30  # images of a topic
WIDTH = 118  # columns of text
RANGE = (0.2, 6.0)  # [m] of depth that is compared between views


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "check", run)
    parser.add_argument(
        "source",
        type=Path,
        nargs="+",
        help=".mcap, .bag, .db3, ROS 2 bag folder, capture, folder of a dataset, or .toml of an image folder;"
        " several logs of one session are read as one",
    )
    parser.add_argument(
        "--fail-on",
        choices=["error", "warning", "never"],
        default="error",
        help="exit with 1 where a finding is as bad as this (default: error)",
    )
    parser.add_argument(
        "--quick",
        type=_num_images,
        nargs="?",
        const=QUICK,
        metavar="N",
        help=f"read the first N images of a topic only (default of N: {QUICK})",
    )
    parser.add_argument("--urdf", type=Path, metavar="FILE", help="compare joint states and depth with this robot")
    parser.add_argument("--spheres", type=Path, metavar="FILE", help="its spheres (default: those of the URDF)")
    parser.add_argument(
        "--base", metavar="X,Y,Z,QX,QY,QZ,QW", help="pose of the URDF's root in the world (default: at its origin)"
    )
    add_lock(parser)
    add_source(parser)


def _num_images(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        hint = f"put it behind the input, or write --quick={QUICK}"
        raise argparse.ArgumentTypeError(f"expected a number of images, got {text!r}: {hint}") from None


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    if args.quick is not None and args.quick < 1:
        raise UsageError(f"--quick {args.quick}: expected 1 or more")
    options, model = source_options(args), _robot(args)
    log = open_logs(args.source)
    if log is None:
        report = check_source(args.source[0], options, model=model, num_images=args.quick)
    else:
        report = check_log(log, options, model=model, num_images=args.quick)
    report = replace(report, findings=[*report.findings, *_agreement(report)])
    verdict = _verdict(report, fail_on=args.fail_on)
    code = 0 if args.fail_on == "never" else verdict.exit_code
    Console(args).concluded(verdict, report.as_dict(), _lines(report), code, has_findings=True)
    return code


def _verdict(report: "CheckReport", *, fail_on: str) -> "Verdict":
    """Of the findings: errors, and warnings where asked for, fail; the other warnings are notes."""
    fatal = {Severity.ERROR, *([Severity.WARNING] if fail_on == "warning" else [])}
    read = Reason(
        criterion="messages",
        outcome=Outcome.PASSED if report.num_messages else Outcome.NOT_EVALUABLE,
        sentence=f"{report.num_messages} {report.unit} read",
        value=float(report.num_messages),
        threshold=1.0,
        count=report.num_messages,
    )
    found = [
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
        "check", [read, *found], scope=f"{Path(report.path).name}: {counts}", counts={"messages": report.num_messages}
    )


def _robot(args: argparse.Namespace) -> "RobotModel | None":
    if args.urdf is None:
        given = [name for name in ("spheres", "base") if getattr(args, name) is not None]
        if given or args.lock:
            raise UsageError(f"--{(given or ['lock'])[0]}: expected --urdf beside it")
        return None
    base = None if args.base is None else _seven(args.base)
    T_world_base = None if base is None else transform_from(base[:3], base[3:])
    return RobotModel.from_urdf(args.urdf, args.spheres, T_world_base=T_world_base, locked=locked_joints(args.lock))


def _seven(text: str) -> tuple[float, ...]:
    values = several(text)
    if len(values) != 7 or not 0.5 < sum(v * v for v in values[3:]) < 2.0:
        raise UsageError(f"--base {text}: expected X,Y,Z,QX,QY,QZ,QW with a unit quaternion")
    return values


def _agreement(report: "CheckReport") -> list["Finding"]:
    """Whether views agree on where the surfaces are that both see."""
    findings: list[Finding] = []
    good: list[float] = []
    for pair in agreements(list(report.frames), *RANGE):
        both = list(dict.fromkeys(pair.cameras))
        where = f"camera {both[0]}" if len(both) == 1 else f"cameras {both[0]} and {both[1]}"
        text = f"depths differ by {1e3 * pair.median:.1f} mm (median of {pair.num_pixels} pixels that two views see)"
        if pair.holds:
            good.append(pair.median)
            continue
        text = f"{text}; expected at most {1e3 * pair.limit:.0f} mm"
        remedy = f"{CAUSES}: calibrate the cameras' poses again (hand-eye), or widen the range of depth"
        remedy += f", or keep one with --cameras {both[0]}" if len(both) > 1 else ": is it the pose of another frame?"
        findings.append(error("agreement", where, text, remedy, value=round(1e3 * pair.median, 2), unit="mm"))
    if good:
        text = f"where views see one surface their depths differ by {1e3 * max(good):.1f} mm (median of its pixels)"
        if len(good) > 1:
            middle = 1e3 * statistics.median(good)
            text = f"{text} in the worst of {len(good)} pairs of cameras or views of one, by {middle:.1f} mm in most"
        findings.append(note("agreement", "cameras", text, value=round(1e3 * max(good), 2), unit="mm"))
    return findings


def _lines(report: "CheckReport") -> Iterator[str]:
    span = f", {report.duration_s:.2f} s" if report.duration_s else ""
    num = f", {report.num_messages} {report.unit}" if report.num_messages else ""
    yield f"{report.path}: {report.kind}{span}{num}"
    for finding in report.sorted_findings:
        yield ""
        at = report.seconds(finding)
        when = "" if at is None else f", at {at:.3f} s"
        yield f"{finding.severity}: {finding.where}{when} [{finding.code}]"
        yield from textwrap.wrap(finding.what, WIDTH, initial_indent="  ", subsequent_indent="  ")
        if finding.remedy:
            yield from textwrap.wrap(f"-> {finding.remedy}", WIDTH, initial_indent="  ", subsequent_indent="     ")
    rates = [rate for rate in report.rates if rate.is_read]
    if rates:
        yield ""
        yield from table(["topic", "messages", "hz", "longest gap s", "delay s"], [*map(_rate_row, rates)])
    if len(rates) < len(report.rates):
        yield from () if rates else ("",)
        others = len(report.rates) - len(rates)
        yield f"{others} topic{'' if others == 1 else 's'} that no command reads"
    yield ""
    yield from _needs(report)


def _needs(report: "CheckReport") -> Iterator[str]:
    """Commands that can start, those that errors keep from it, then what each lacks beside."""
    ready = [need.command for need in report.needs if not report.lacks(need)]
    if ready:
        yield f"can start: {', '.join(ready)}"
    kept: dict[str, list[str]] = {}
    for need in report.needs:
        codes = dict.fromkeys(finding.code for finding in report.refusing(need))
        if codes:
            kept.setdefault(", ".join(f"[{code}]" for code in codes), []).append(need.command)
    for why, commands in kept.items():
        yield f"cannot start, or would be wrong: {', '.join(commands)}; see {why}"
    for need in report.needs:
        for lack in need.lacks:
            yield from textwrap.wrap(f"missing for {need.command}: {lack}", WIDTH, subsequent_indent="  ")


def _rate_row(rate: "Rate") -> list[object]:
    return [rate.topic, rate.messages, _shown(rate.hz, 2), _shown(rate.longest_s, 3), _shown(rate.delay_s, 3)]


def _shown(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
