"""Recordings opened to train on or score, and checked for agreement."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

from splatctrl_cli.checks.check_views import are_far, check_views, rescale_remedy
from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.evaluate.protocols import ScoreProtocol, Split, score_protocol
from splatctrl_cli.jobs.check import refuse_errors
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.capture.capture import is_capture
from splatctrl_cli.recording.folder.idr import DtuSource, view_numbers
from splatctrl_cli.recording.folder.image_folder import ImageFolderSource, has_views
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RecordSource
from splatctrl_cli.scene.recording_consistency import CAUSES, agreements, largest_jump
from splatctrl_cli.scene.time_steps import TimeStep


@dataclass(frozen=True, kw_only=True)
class RecordingRequest:
    """Recording at `path`: log, capture, image folder, or DTU data set.

    scan: None for the only one. options: a scan uses only `holdout`. protocol: names a split of the views. masks,
    depths: folders for a scan. downscale: None for the protocol's size. others: more logs of the session. Raises
    UsageError if `others` is given with an image folder.
    """

    path: Path
    is_dtu: bool = False
    options: SourceOptions = field(default_factory=SourceOptions)
    scan: str | None = None
    protocol: str | None = None
    masks: Path | None = None
    depths: Path | None = None
    downscale: int | None = None
    others: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        refuse_if(
            self.others and is_folder_of_views(self.path),
            f"--reference {self.path}: expected a log, as the others are, got a folder of images",
            error=UsageError,
        )


def open_to_train(
    recording: RecordingRequest,
    *,
    max_pose_jump: float = fixed.POSE_JUMP,
    needs_depth: bool = True,
    allowed: Collection[str] = (),
) -> RecordSource:
    """Open the recording without held-out views.

    Raises UsageError for options of another kind of recording. Raises InputError for a scan without depth, a camera
    jump above `max_pose_jump` [m], and errors of `check` not in `allowed`.
    """
    if recording.is_dtu:
        scan = open_dtu(recording)
        refuse_if(
            needs_depth and not scan.has_depth,
            f"{recording.path}: scan '{scan.name}' has no depth",
            remedy="give --depths DIR, or --points FILE.ply instead",
        )
        return scan
    refuse_scan_options(recording)
    if recording.protocol is not None:
        return open_held_out(recording, needs_depth=needs_depth)[0]
    source = open_source(recording.path, recording.options, needs_depth=needs_depth)
    check_pose_jumps(source, max_pose_jump)
    if needs_depth:
        jumps = () if max_pose_jump == fixed.POSE_JUMP else ("pose-jump",)
        later = "agreement"  # `CameraAgreement` checks it, with the map's poses
        refuse_errors(recording.path, recording.options, (*allowed, *jumps, later))
    return source


def open_dtu(recording: RecordingRequest) -> DtuSource:
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
    """Open an image folder; protocol holdout:RULE holds views out by position."""
    name, path = recording.protocol or "", recording.path
    protocol = score_protocol(name)
    refuse_if(
        not is_folder_of_views(path) or not name.startswith("holdout:"),
        f"--protocol {name}: expected --dtu, or holdout:RULE and an image folder (its TOML, or that of a dataset)",
        remedy="leave --protocol out, or give --dtu ROOT",
        error=UsageError,
    )
    refuse_if(
        recording.options.holdout,
        "--holdout: the protocol holds views out already",
        remedy="give --holdout or --protocol, not both",
        error=UsageError,
    )
    options = replace(recording.options, cameras=None)
    num = sum(1 for _ in open_source(path, options, needs_depth=needs_depth).poses())
    split = protocol.split(range(num), str(path))
    options = replace(options, holdout=tuple(map(str, split.scored)))
    return open_source(path, options, needs_depth=needs_depth), protocol, split


def is_folder_of_views(path: Path) -> bool:
    """True for an image folder, described by a TOML or a dataset's layout."""
    return path.suffix == ".toml" or (not is_capture(path) and has_views(path))


def guessed_unit(source: RecordSource) -> str:
    """Guessed unit of lengths other than metres, in words; usually empty."""
    return source.guess if isinstance(source, ImageFolderSource) else ""


def refuse_scan_options(recording: RecordingRequest) -> None:
    """Raise UsageError for DTU options without a DTU scan."""
    for name in ("scan", "depths", "downscale", "masks"):
        refuse_if(
            getattr(recording, name),
            f"--{name} {getattr(recording, name)}: only with --dtu",
            remedy="leave it out",
            error=UsageError,
        )


def check_pose_jumps(source: FrameSource, limit: float) -> None:
    """Raise InputError for a camera jump above `limit` [m]; views without times may lie anywhere."""
    refuse_if(not limit > 0, f"--max-pose-jump: expected metres, got {limit}", error=UsageError)
    jump = largest_jump(source.poses()) if source.has_clock else None
    if jump is not None and jump.distance > limit:
        later = (jump.after_ns - jump.before_ns) * 1e-9
        raise InputError(
            f"{source.name}: camera {jump.camera} jumps by {jump.distance:.2f} m from stamp {jump.before_ns} to"
            f" {jump.after_ns} ns, {later:.3g} s later (expected at most {limit:g} m)",
            remedy=f"correct the poses, leave the camera out with --cameras, or give --max-pose-jump"
            f" {jump.distance + 0.01:.2f}",
        )


class CameraAgreement:
    """Agreement of cameras; disagreement: median difference [m] of depths, by pair.

    is_allowed: warn instead of refusing. is_still: views of a step show the same scene. guess: a guessed unit, in
    words.
    """

    def __init__(self, source: RecordSource, *, is_allowed: bool, is_still: bool, guess: str = "") -> None:
        self.disagreement: dict[str, float] = {}
        self._source, self._name = source, source.name
        self._is_allowed, self._is_still, self._guess = is_allowed, is_still, guess

    def check(self, step: TimeStep, limits: OccupancyConfig, console: Progress) -> None:
        """Compare each pair of cameras once; check a still scene's depth scale.

        Raises InputError for surfaces too far apart, or views that fit only at another depth scale.
        """
        names = sorted(frame.camera for frame in step.frames)
        if {" and ".join(dict.fromkeys(pair)) for pair in combinations(names, 2)} <= self.disagreement.keys():
            return
        if self._is_still and not self.disagreement:
            self._check_scale(step, console)
        for pair in agreements(step.frames, limits.min_range, limits.max_range):
            name = " and ".join(dict.fromkeys(pair.cameras))
            if name in self.disagreement:
                continue
            self.disagreement[name] = round(pair.median, 5)
            if pair.holds:
                continue
            line = (
                f"{self._name}: camera {name}: depths disagree by {1e3 * pair.median:.0f} mm (median of"
                f" {pair.num_pixels} pixels that two views see; expected at most {1e3 * pair.limit:.0f} mm)"
            )
            others = f" keep one with --cameras {pair.cameras[0]}," if len(set(pair.cameras)) > 1 else ""
            refine = " (--refine-poses)" if self._is_still else " (splatctrl calibrate)"
            refuse_if(
                not self._is_allowed,
                line,
                remedy=f"{CAUSES}: correct poses or depth{refine},{others} or give --allow-disagreement",
            )
            console.log(f"warning: {line}; {CAUSES}: correct poses or depth, or expect surfaces twice")

    def _check_scale(self, step: TimeStep, console: Progress) -> None:
        if self._guess:
            console.log(f"warning: {self._name}: {self._guess}; the map is in metres")
        findings = check_views(
            step.frames,
            dict.fromkeys(sorted({frame.camera for frame in step.frames})),
            is_sure=not self._guess and not are_far(step.frames),
        )[0]
        for finding in [finding for finding in findings if finding.code == "views-scale"]:
            if not self._is_allowed:
                remedy = rescale_remedy(self._units(), finding.value or 1.0)
                raise InputError(
                    f"{self._name}: {finding.what}",
                    remedy=f"{remedy}, or correct the poses' unit; if both are right, give --allow-disagreement",
                )
            console.log(f"warning: {self._name}: {finding.what}")

    def _units(self) -> set[float | None]:
        """Depth units [m per count] by camera; None if unknown."""
        units = dict[str, float | None]()
        for frame in self._source.stored() if isinstance(self._source, LOGGED | ImageFolderSource) else ():
            if isinstance(frame, StoredFrame):
                units.setdefault(frame.camera, frame.depth_unit)
            if len(units) == len(self._source.cameras):
                break
        return {*units.values()} or {None}
