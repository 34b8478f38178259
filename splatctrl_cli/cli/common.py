"""Options and output of several subcommands; imports nothing heavy, for quick help."""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar

from splatctrl_cli.cli.parser import Adds, group, join_run_options, option, real, several, whole
from splatctrl_cli.cli.reports import report_command, wrap_result
from splatctrl_cli.config import PRESETS, Config, fixed, load_config
from splatctrl_cli.config.ranges import MAX_PLACE, MAX_SEED, checked_pose, format_value
from splatctrl_cli.errors import UsageError, refuse_faults, refuse_if
from splatctrl_cli.evaluate.verdict import JudgedResult, Result, gate
from splatctrl_cli.files.output import plain
from splatctrl_cli.recording.source_options import NUM_COEFFICIENTS, CameraTopics

T = TypeVar("T")

POSE = "X,Y,Z,QX,QY,QZ,QW"
BOX = "X0,Y0,Z0,X1,Y1,Z1"
SEVERAL_LOGS = "several logs of one session are read as one"


def request_of(kind: type[T], args: argparse.Namespace, **fields_given: Any) -> T:
    """Build a request from `fields_given`, else options, else defaults, including nested requests.

    Raises UsageError for a wrong value.
    """
    all_fields = fields(kind)  # type: ignore[arg-type]
    left: dict[str, Any] = {
        field.name: field.default_factory for field in all_fields if field.name not in fields_given
    }
    values = dict(fields_given)
    for action in args.parser._actions:
        value = getattr(args, action.dest, None)
        for name, read in action.fields.items():
            if name in left and value is not None:
                values[name] = (resolve_name(f"splatctrl_cli.{read}") if isinstance(read, str) else read)(value)
    for name, made_by in left.items():
        if made_by is Config:
            values[name] = config_of(args)
        elif isinstance(made_by, type) and is_dataclass(made_by):
            values[name] = request_of(made_by, args)
    return kind(**values)


def config_of(args: argparse.Namespace) -> Config:
    """Read the configuration: --config and --set, then options that set one key."""
    overrides = {action.sets: getattr(args, action.dest) for action in args.parser._actions if action.sets}
    ours = [f"{key}={value}" for key, value in overrides.items() if value is not None]
    return load_config(args.config, [*args.set, *ours])


def _pairs(read: Callable[[str], tuple[str, Any]]) -> Callable[[Iterable[str]], dict[str, Any]]:
    return lambda texts: dict(map(read, texts))


def _number_of(option: str, what: str, assignment: str) -> tuple[str, float]:
    name, _, text = assignment.partition("=")
    value = several(text)
    refuse_if(
        len(value) != 1, f"{option} {assignment}: expected {what}=VALUE, got {text!r} for the value", error=UsageError
    )
    return name, value[0]


def names_of(option: str, choices: Sequence[str], text: str) -> tuple[str, ...]:
    """Names in a comma list, each once. Raises UsageError for an unknown name or none."""
    names = tuple(dict.fromkeys(_names(text)))
    refuse_if(
        not names or not {*names} <= {*choices},
        f"{option} {text}: expected some of: {', '.join(choices)}",
        error=UsageError,
    )
    return names


def pose(text: str) -> tuple[float, ...]:
    with refuse_faults(str, ValueError, error=argparse.ArgumentTypeError):
        return checked_pose(numbers(text))


def _device(text: str) -> str:
    refuse_if(
        not re.fullmatch(r"auto|cpu|cuda(:\d{1,3})?", text),
        f"expected auto, cpu, cuda or cuda:N, got {format_value(text)}",
        error=argparse.ArgumentTypeError,
    )
    return text


def numbers(text: str) -> tuple[float, ...]:
    """Finite numbers joined by commas, for argparse."""
    values = several(text)
    refuse_if(
        not values,
        f"expected finite numbers joined by commas, up to 1e6, got {format_value(text)}",
        error=argparse.ArgumentTypeError,
    )
    return values


def _split_list(option: str, text: str) -> str:
    names = _names(text)
    refuse_if(
        not names, f"{option} {text!r}: expected names, got none", remedy="leave the option out", error=UsageError
    )
    return ",".join(names)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _topics(text: str) -> CameraTopics:
    name, equals, rest = text.partition("=")
    topics = rest.split(",")
    refuse_if(
        not (re.fullmatch(r"\w[\w.-]*", name) and equals and len(topics) in {2, 3} and all(topics)),
        f"--camera {text}: expected NAME=COLOR,DEPTH or NAME=COLOR,DEPTH,INFO",
        error=UsageError,
    )
    return CameraTopics(name=name, color=topics[0], depth=topics[1], info=topics[2] if len(topics) == 3 else "")


def _human_topic(text: str) -> tuple[str, str]:
    name, _, topic = text.partition("=")
    refuse_if(not name or not topic, f"--human-topic {text}: expected NAME=TOPIC", error=UsageError)
    return name, topic


def _pose(text: str) -> tuple[str, tuple[float, ...]]:
    name, _, rest = text.partition("=")
    if name and rest == "identity":
        return name, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    values = several(rest)
    refuse_if(
        not name or len(values) != 7 or not 0.5 < sum(v * v for v in values[3:]) < 2.0,
        f"--camera-pose {text}: expected NAME={POSE} with a unit quaternion, or NAME=identity",
        error=UsageError,
    )
    return name, values


def _pose_topic(text: str) -> tuple[str, tuple[str, str]]:
    name, _, rest = text.partition("=")
    topic, at, frame = rest.partition("@")
    refuse_if(
        not name or not topic or bool(at) != bool(frame),
        f"--camera-pose {text}: expected NAME=TOPIC or NAME=TOPIC@FRAME",
        error=UsageError,
    )
    return name, (topic, frame.strip("/"))


def _intrinsics(text: str) -> tuple[str, tuple[float, ...]]:
    name, _, rest = text.partition("=")
    values = several(rest)
    refuse_if(
        not name or len(values) - 4 not in (0, *NUM_COEFFICIENTS) or not min(values[:2]) > 0,
        f"--intrinsics {text}: expected NAME=FX,FY,CX,CY in pixels, then 0, {', '.join(map(str, NUM_COEFFICIENTS))}"
        " coefficients",
        error=UsageError,
    )
    return name, values


def _preset(text: str) -> str:
    refuse_if(
        text not in PRESETS,
        f"expected {' or '.join(PRESETS)}, got {format_value(text)}",
        error=argparse.ArgumentTypeError,
    )
    return f"preset={text}"


def output(what: str, *, default: str) -> tuple[Adds, ...]:
    return (
        option("-o/--out PATH", f"{what} (default: {default})", Path),
        option("--force", "replace the output if it exists"),
    )


def settings(example: str = "") -> tuple[Adds, ...]:
    paper = "paper: the printed settings (departures: splatctrl help paper)"
    return (
        option("--set SECTION.KEY=VALUE ...", f"one setting{example}"),
        option("--preset NAME", paper, _preset, dest="set", action="append"),
    )


def seed(what: str) -> Adds:
    return option("--seed SEED", f"seed of {what}", whole(0, MAX_SEED), 0)


COMMON = (  # which every command has
    option("--json", "print one JSON object instead of a table"),
    join_run_options(
        option("-v/--verbose", "say more; show tracebacks", action="count", default=0),
        option("-q/--quiet", "no progress, no log lines"),
    ),
)
JUNIT = (  # which every command that judges has
    option("--junit FILE", "write the verdict for CI as JUnit XML, a case for each criterion", Path),
)
THREADS = join_run_options(
    option("--threads THREADS", "threads, at most 16 or one per core (default: one per core)", whole(0, 1024))
)
CONFIG_FILE = option("--config FILE.toml", "settings, see splatctrl config --template", Path)
CONFIG = (CONFIG_FILE, *settings(), join_run_options(seed("everything random")), THREADS)
DEVICE = join_run_options(
    option(
        "--device NAME",
        "where to compute: auto, cpu, cuda or cuda:N; auto takes a card that is worth its start (splatctrl help gpu)",
        _device,
        "auto",
    )
)
GATES = option("--require METRIC>=VALUE ...", "fail (exit 1) unless it holds", gate)
HOLDOUT = option(
    "--holdout 0,6",
    "hold out these frames of an image folder, as camera holdout",
    partial(_split_list, "--holdout"),
    fields={"holdout": lambda text: tuple(text.split(","))},
)
SOURCE = (  # the options of a source, all but --cameras in a group of their own
    option(
        "--cameras A,B",
        "only these cameras",
        partial(_split_list, "--cameras"),
        fields={"cameras": lambda text: tuple(text.split(","))},
    ),
    group(
        "input",
        option(
            "--camera NAME=COLOR,DEPTH[,INFO] ...",
            "topics of a camera, instead of those found",
            fields={"camera_topics": lambda texts: tuple(map(_topics, texts))},
        ),
        option(
            f"--camera-pose NAME={POSE} ...",
            "pose of a fixed camera in the world; or NAME=identity; or NAME=TOPIC[@FRAME], a topic of its poses, or"
            " of FRAME's",
            fields={
                "camera_poses": lambda texts: dict(_pose(text) for text in texts if "=/" not in text),
                "camera_pose_topics": lambda texts: dict(_pose_topic(text) for text in texts if "=/" in text),
            },
        ),
        option(
            "--intrinsics NAME=FX,FY,CX,CY[,K1,K2,P1,P2...] ...",
            "of a camera [px], and its distortion where it has one, instead of the recorded ones",
            fields={"intrinsics": _pairs(_intrinsics)},
        ),
        option(
            "--human-topic NAME=TOPIC ...",
            "mono8 masks of a camera's colour images, not 0 where they show a person",
            fields={"human_topics": _pairs(_human_topic)},
        ),
        option("--world-frame FRAME", "tf frame of poses (default: root of the tf tree)"),
        option("--depth-scale M", "metres per count of depth (default: 0.001)", real(1e-9, 1e3, "m")),
        option(
            "--pairing-tolerance S",
            "colour to depth, seconds",
            real(0, 3600, "s"),
            0.02,
            fields={"pairing_tolerance_s": float},
        ),
        option("--calibration FILE.toml", "what calibrate wrote: poses, depths and clock of this recording", Path),
        option(
            "--perturb NAME=VALUE ...",
            "read frames with errors: depth-noise (m at 1 m), pose-error (m), pose-turn (degrees); seed of these",
            fields={"perturb": _pairs(partial(_number_of, "--perturb", "NAME"))},
        ),
        option("--stamps", "a log's times: those of the headers, or of logging", ("header", "log"), "header"),
        option("--joint-topic TOPIC", "JointState topic (default: /joint_states)"),
        option("--root DIR", "folder of the images that a .toml describes", Path),
    ),
)
OF_FOLDERS = (SOURCE[0], HOLDOUT, SOURCE[1])  # likewise, of commands that read image folders
SCAN = (  # the options of a DTU scan
    option("--scan NAME", "which scan of --dtu (default: the only one)"),
    option(
        "--protocol NAME",
        "which views train and which are scored: dtu-train, dtu-holdout8, regnerf-3, regnerf-6, regnerf-9, mvsnerf,"
        " holdout:everyN, holdout:everyN+FIRST or holdout:2,5 (splatctrl help score)",
    ),
    option("--depths DIR", "depth_map_0000.pfm and so on of a scan in IDR's layout", Path),
    option(
        "--downscale N",
        "make images of --dtu N times smaller (default: as the protocol has them, if N is whole)",
        whole(1, 64),
    ),
)
DISAGREEMENT = (  # by how much a log may contradict itself
    option(
        "--max-pose-jump M",
        "how far a camera may move between frames less than a second apart",
        real(1e-3, MAX_PLACE, "m"),
        fixed.POSE_JUMP,
    ),
    option("--allow-disagreement", "continue although cameras disagree about surfaces"),
)
DECLARE = option("--declare FILE.toml", "what the robot carries, contact meant (splatctrl help declare)", Path)
PACKAGES = option(
    "--packages DIR ...", "where package:// paths of the URDF are found (default: the folders above it)", Path
)
SELF_MODEL = option(
    "--self-model FILE.npz",
    "self-model of 'robot learn' (none: learn and apply nothing)",
    Path,
)
LOCK = option(
    "--lock JOINT=VALUE ...",
    "hold a joint, and what mimics it, at a value [rad or m]",
    fields={"locked": _pairs(partial(_number_of, "--lock", "JOINT"))},
)
BASE = option(f"--base {POSE}", "pose of the URDF's root in the world (default: by tf, else at its origin)", pose)


_NUMBER = re.compile(r"^[-+]?[\d.]|^(nan|-)$")


class Console:
    """Output of a command: results to stdout, log lines to stderr, verdicts to CI."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        self.is_json, self.is_quiet = bool(args.json), bool(args.quiet)
        self.reports_to_ci = hasattr(args, "junit")

    def log(self, line: str) -> None:
        if not self.is_quiet:
            print(line, file=sys.stderr, flush=True)

    def result(self, result: Mapping[str, Any], lines: Iterable[str], *, code: int = 0) -> int:
        """Print `result` as JSON with --json, else `lines`; return `code`."""
        if self.is_json:
            text = json.dumps(wrap_result(result, code), indent=2, allow_nan=False, default=plain)
            self._args.is_printed = True
            print(text)
        else:
            for line in lines:
                print(line)
        return code

    def show(
        self, result: Result, lines: Iterable[str], *, code: int | None = None, has_findings: bool = False
    ) -> int:
        """Print a job's verdict, if any, and its document or `lines`; return the exit code.

        has_findings: `lines` contain the reasons.
        """
        document = result.document or {"out": result.out, **result.metrics}
        if not isinstance(result, JudgedResult):
            return self.result(document, lines, code=code or 0)
        verdict = result.verdict
        code = verdict.exit_code if code is None else code
        self._args.label = verdict.label
        if self.is_json:
            self.result({"verdict": verdict.as_dict(), **document}, (), code=code)
        else:
            print(verdict.sentence)
            for reason in () if has_findings else verdict.decisive[1:10]:  # --json and summary.json have all
                print(f"  {reason.outcome}: {reason}")
            for reason in () if has_findings else verdict.shown:
                print(f"  note: {reason}")
            print()
            self.result({}, lines)
        if code and self.is_json:
            gates = [str(reason) for reason in verdict.decisive[1:] if reason.criterion.startswith("--require")]
            print("\n".join(f"splatctrl: {line}" for line in (verdict.sentence, *gates)), file=sys.stderr, flush=True)
        if self.reports_to_ci:
            report_command(self._args, verdict.as_dict(), code)
        return code


def remarks(*texts: tuple[str, object]) -> list[str]:
    return [text for text, holds in texts if holds]


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    return list(long_table(header, lambda: rows))


def long_table(header: Sequence[str], rows: Callable[[], Iterable[Sequence[object]]]) -> Iterator[str]:
    """Lines of a `table` in bounded memory: `rows` is called twice, first for widths."""
    widths, is_number = [len(name) for name in header], [True] * len(header)
    for row in rows():
        for i, cell in enumerate(map(str, row)):
            widths[i] = max(widths[i], len(cell))
            is_number[i] = is_number[i] and _NUMBER.match(cell) is not None

    def line(row: Sequence[object]) -> str:
        cells = zip(map(str, row), widths, is_number, strict=True)
        return "  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in cells).rstrip()

    yield line(header)
    yield "  ".join("-" * width for width in widths)
    yield from map(line, rows())


def format_cell(value: object, form: str = ".4g") -> str:
    """A value in a table: floats by `form`, a dash for nothing."""
    if value is None or value == "":
        return "-"
    return format(value, form) if isinstance(value, float) else str(value)
