"""Conversion of recordings into capture folders."""

import json
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path

from splatctrl_cli import __version__
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_run
from splatctrl_cli.jobs.running.device import advise_resumption, check_same_run
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.capture.capture_writer import JOURNAL, read_identity, write_capture
from splatctrl_cli.recording.folder.folder_views import HOLDOUT
from splatctrl_cli.recording.source import logged_descriptions, open_session
from splatctrl_cli.recording.source_options import SourceOptions

DECIDING_PACKAGES = ("numpy", "opencv-python-headless")  # whose versions may change a byte of a capture


@dataclass(frozen=True, kw_only=True)
class IngestRequest:
    """Write a recording as a capture; several `paths` only for logs of one session.

    out: None for NAME.capture here, by the first path.
    """

    paths: tuple[Path, ...]
    out: Path | None = None
    options: SourceOptions = field(default_factory=SourceOptions)
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
        said = ", ".join(where for _, where, _ in robots)
        progress.log(
            f"warning: {len(robots)} robots are described, by {said}: none is stored; give --urdf to each command"
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
