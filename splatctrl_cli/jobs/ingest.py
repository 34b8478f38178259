"""Recorded inputs into capture folders, and capture folders into one MCAP and back."""

import functools
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.captures.capture_pack import pack_capture, unpack_capture
from splatctrl_cli.captures.capture_writer import JOURNAL, CaptureSummary, read_identity, write_capture
from splatctrl_cli.datasets.image_folder import HOLDOUT
from splatctrl_cli.errors import DAMAGED, InputError, UsageError
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_run
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.reconstructions.resume import check_same_run, told_how_to_go_on
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.sources.calibrated import LOGGED
from splatctrl_cli.sources.source import logged_descriptions, open_session


@dataclass(frozen=True, kw_only=True)
class IngestRequest:
    """Write the recording as the capture folder `out` (None: NAME.capture here, NAME that of the first of `paths`).

    paths: several only where they are logs of one session.
    """

    paths: tuple[Path, ...]
    out: Path | None = None
    options: SourceOptions = field(default_factory=SourceOptions)
    force: bool = False
    resume: bool = False


@dataclass(frozen=True, kw_only=True)
class IngestResult:
    """The capture folder, and what was written into it."""

    capture: Path
    summary: CaptureSummary

    @property
    def metrics(self) -> dict[str, Any]:
        written = self.summary
        return {"frames": written.num_frames, "joint_states": written.num_joint_states, "loss": asdict(written.loss)}

    @property
    def exit_code(self) -> int:
        """3 where part of the input was damaged."""
        return DAMAGED if self.summary.loss.damaged else 0


@dataclass(frozen=True, kw_only=True)
class PackRequest:
    """Pack the capture folder `source` into one MCAP, or unpack such a file; out: None for a name like its own."""

    source: Path
    out: Path | None = None
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class PackResult:
    """What was written; bytes: the size of a file, None of a folder."""

    out: Path
    num_frames: int
    bytes: int | None = None


def ingest(request: IngestRequest, progress: Progress = SILENT) -> IngestResult:
    """Write the capture, or go on with one that was interrupted, to the same bytes.

    Raises UsageError where no camera is left to train with or another run was interrupted, InputError for a recording
    that cannot be used.
    """
    stopwatch, options = Stopwatch(), request.options
    out = request.out or Path(request.paths[0].stem + ".capture")
    with stopwatch.stage("survey"):
        source = open_session(request.paths, options)
        topics = None
        if isinstance(source, LOGGED):
            topics = source.joint_topics
    if set(source.cameras) == {HOLDOUT}:
        given = ",".join(options.cameras or ())
        raise UsageError(f"--cameras {given}: leaves no camera to train with", remedy="name another, or leave it out")
    robots = [description for _, description in logged_descriptions(request.paths)]
    if len(robots) > 1:
        said = ", ".join(robot.where for robot in robots)
        progress.log(
            f"warning: {len(robots)} robots are described, by {said}: none is kept; give --urdf to each command"
        )
    progress.log(f"{source.name}: cameras {', '.join(source.cameras)}; {len(source.joint_names)} joints")
    identity = _identity(options, source.digests())
    journal = partial_path(out) / JOURNAL
    with (
        told_how_to_go_on(journal, journal.parent),
        output_path(out, force=request.force, is_folder=True, checkpoint=JOURNAL, resume=request.resume) as partial,
    ):
        before = read_identity(partial)
        if before is not None:
            check_same_run(partial, before, identity)
        with stopwatch.stage("write"):
            summary = write_capture(
                partial,
                source,
                topics=topics,
                robot=robots[0].text if len(robots) == 1 else "",
                progress=functools.partial(_log_hundredth, progress),
                identity=identity,
            )
        if summary.num_resumed:
            progress.log(f"{summary.num_resumed} frames were there already")
        result = IngestResult(capture=out, summary=summary)
        write_run(
            partial,
            command="ingest",
            config=asdict(options),
            inputs=source.digests(),
            metrics=result.metrics,
            stopwatch=stopwatch,
        )
    return result


def pack(request: PackRequest, progress: Progress = SILENT) -> PackResult:
    """Write a capture folder as one MCAP. Raises InputError for what is none."""
    source = request.source
    if not source.is_dir():
        raise InputError(f"{source}: no such folder", remedy="expected what `splatctrl ingest` writes")
    out = request.out or Path(source.resolve().name.removesuffix(".capture") + ".mcap")
    with output_path(out, force=request.force, is_folder=False) as partial:
        num_frames = pack_capture(source, partial, functools.partial(_log_hundredth, progress))
        return PackResult(out=out, num_frames=num_frames, bytes=partial.stat().st_size)


def unpack(request: PackRequest) -> PackResult:
    """Write the capture folder that an MCAP was made of. Raises InputError for what is none."""
    source = request.source
    if not source.is_file():
        raise InputError(f"{source}: no such file", remedy="expected what `splatctrl capture pack` writes")
    out = request.out or Path(source.stem + ".capture")
    with output_path(out, force=request.force, is_folder=True) as partial:
        return PackResult(out=out, num_frames=unpack_capture(source, partial))


def _log_hundredth(progress: Progress, num_frames: int) -> None:
    if num_frames % 100 == 0:
        progress.log(f"{num_frames} frames")


def _identity(options: SourceOptions, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Everything that decides the bytes of a capture, as plain values; inputs: sha256 by name."""
    versions = {name: metadata.version(name) for name in ("numpy", "opencv-python-headless")}
    values = {"splatctrl": __version__, **versions, "options": asdict(options), "sha256": dict(inputs)}
    plain: dict[str, Any] = json.loads(json.dumps(values, default=str))
    return plain
