"""Which recording a job trains on or compares with, and how it is opened."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from splatctrl_cli.captures.capture_header import is_capture
from splatctrl_cli.config.fixed import POSE_JUMP
from splatctrl_cli.datasets.dtu_source import DtuSource, view_numbers
from splatctrl_cli.datasets.image_folder import ImageFolderSource
from splatctrl_cli.datasets.layouts import has_views
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.protocols import ScoreProtocol, Split, score_protocol
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.logs.stored_frame import FrameSource
from splatctrl_cli.records import RecordSource
from splatctrl_cli.scene.recording_consistency import largest_jump
from splatctrl_cli.sources.source import open_source


@dataclass(frozen=True, kw_only=True)
class RecordingRequest:
    """path: a log, a capture or an image folder, or a DTU data set, of whose scans it is `scan` (None: the only one).

    options: how it is read; of a scan, its holdout alone. protocol: which views train and which are scored. masks,
    depths: folders with what the layout of the scan lacks. downscale: by how much its images are made smaller (None:
    down to the size of the protocol).
    """

    path: Path
    is_dtu: bool = False
    options: SourceOptions = field(default_factory=SourceOptions)
    scan: str | None = None
    protocol: str | None = None
    masks: Path | None = None
    depths: Path | None = None
    downscale: int | None = None


def open_to_train(
    recording: RecordingRequest, *, max_pose_jump: float = POSE_JUMP, needs_depth: bool = True
) -> RecordSource:
    """The recording without the views that it holds out. Raises UsageError for options that do not belong to it, and
    InputError for a scan without depth and for a camera that jumps farther than `max_pose_jump` [m].
    """
    if recording.is_dtu:
        scan = open_dtu(recording)
        if needs_depth and not scan.has_depth:
            raise InputError(
                f"{recording.path}: scan '{scan.name}' has no depth",
                remedy="give --depths DIR, or --points FILE.ply instead",
            )
        return scan
    refuse_scan_options(recording)
    if recording.protocol is not None:
        return open_held_out(recording, needs_depth=needs_depth)[0]
    source = open_source(recording.path, recording.options, needs_depth=needs_depth)
    check_pose_jumps(source, max_pose_jump)
    return source


def open_dtu(recording: RecordingRequest) -> DtuSource:
    """A scan of a DTU data set."""
    return DtuSource(
        recording.path,
        recording.scan,
        view_numbers(recording.options.holdout or ()),
        protocol=None if recording.protocol is None else score_protocol(recording.protocol),
        masks=recording.masks,
        depths=recording.depths,
        downscale=recording.downscale,
    )


def open_held_out(
    recording: RecordingRequest, *, needs_depth: bool = False
) -> tuple[FrameSource, ScoreProtocol, Split]:
    """An image folder with the views held out that the protocol holdout:RULE names, by their places in it."""
    name, path = recording.protocol or "", recording.path
    protocol = score_protocol(name)
    if not is_folder_of_views(path) or not name.startswith("holdout:"):
        raise UsageError(
            f"--protocol {name}: expected --dtu, or holdout:RULE and an image folder (its TOML, or that"
            " of a dataset)",
            remedy="leave --protocol out, or give --dtu ROOT",
        )
    if recording.options.holdout:
        raise UsageError("--holdout: the protocol says what is held out", remedy="leave one of them out")
    options = replace(recording.options, cameras=None)
    num = sum(1 for _ in open_source(path, options, needs_depth=needs_depth).poses())
    split = protocol.split(range(num), str(path))
    options = replace(options, holdout=tuple(map(str, split.scored)))
    return open_source(path, options, needs_depth=needs_depth), protocol, split


def is_folder_of_views(path: Path) -> bool:
    """Whether a recording is images in a folder, by a TOML or in a dataset's layout; not a log, not a capture."""
    return path.suffix == ".toml" or (not is_capture(path) and has_views(path))


def guessed_unit(source: RecordSource) -> str:
    """In which unit other than metres a recording's lengths look to be, in words; empty for most."""
    return source.guess if isinstance(source, ImageFolderSource) else ""


def refuse_scan_options(recording: RecordingRequest) -> None:
    """Raise UsageError for what belongs to a DTU scan where there is none."""
    for name in ("scan", "depths", "downscale", "masks"):
        if getattr(recording, name):
            raise UsageError(f"--{name} {getattr(recording, name)}: only with --dtu", remedy="leave it out")


def check_pose_jumps(source: FrameSource, limit: float) -> None:
    """Raise InputError for a camera that is suddenly elsewhere; where nobody knows when, views may lie anywhere."""
    if not limit > 0:
        raise UsageError(f"--max-pose-jump: expected metres, got {limit}")
    jump = largest_jump(source.poses()) if source.has_clock else None
    if jump is not None and jump.distance > limit:
        later = (jump.after_ns - jump.before_ns) * 1e-9
        raise InputError(
            f"{source.name}: camera {jump.camera} jumps by {jump.distance:.2f} m from stamp {jump.before_ns} to"
            f" {jump.after_ns} ns, {later:.3g} s later (expected at most {limit:g} m)",
            remedy=f"correct the poses, leave the camera out with --cameras, or give --max-pose-jump"
            f" {jump.distance + 0.01:.2f}",
        )
