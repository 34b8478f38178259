"""A report on a run or batch, or a 3-D view, in one HTML file."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatctrl_cli.errors import DAMAGE, InputError, SplatCtrlError
from splatctrl_cli.evaluate.verdict import Result, Verdict
from splatctrl_cli.files.output import output_path
from splatctrl_cli.jobs.batch.graph import columns_of
from splatctrl_cli.jobs.batch.ledger import Run
from splatctrl_cli.jobs.batch.run import DONE
from splatctrl_cli.jobs.report.sections import PASSED, changes_since, section_of
from splatctrl_cli.jobs.report.spaces import space_of, space_of_run
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.runs.run_folder import (
    REPLAY,
    BatchFolder,
    FolderRequest,
    RunFolder,
    is_batch,
    open_batch,
    open_run,
    sibling_path,
)
from splatctrl_cli.report.page import Cell, Page, Picture, RunSection, Table, pack, picture, render_page

MOST_SCENES = 6  # of a batch, without `all_scenes`
MOST_ROWS = 40  # of recordings that are shown at once
WITH_SPACE = ("replay", "reconstruct", "sdf-bake")
WITH_PICTURES = {  # by command: part of a picture's name, and its caption
    "score": ("_best_worst", "photo, render and depth error of the best and the worst view"),
    "sdf-bake": ("slices", "slices of the distance"),
}
MOST_PICTURES, PICTURE_WIDTH = 24, 560  # number and width [px] for recordings as expected


@dataclass(frozen=True, kw_only=True)
class ViewRequest(FolderRequest):
    """Page on a run, scene, field, grid or splat file; out: None for PATH.html."""


@dataclass(frozen=True, kw_only=True)
class WriteReportRequest(ViewRequest):
    """HTML report on a run's or batch's folder; out: None for PATH.html.

    against: an earlier run, batch or baseline to compare with. all_scenes: show all of a batch in 3-D, not only
    failed, changed and worst scenes.
    """

    against: Path | None = None
    all_scenes: bool = False


def write_report(request: WriteReportRequest, progress: Progress = SILENT) -> Result:
    """Write the page; metrics: bytes, num_runs, num_scenes; notes: why runs lack a 3-D scene.

    Raises InputError if `path` is no run or batch, incomplete, too new, or not comparable with `against`.
    """
    page = (
        _page_of_batch(request, open_batch(request.path), progress)
        if is_batch(request.path)
        else _page_of_run(request, open_run(request.path))
    )
    notes = tuple(f"{run.title or run.anchor}: {run.no_space}" for run in page.runs if run.no_space)
    written = _write(request, page, num_runs=len(page.runs), num_scenes=len(page.scenes))
    return replace(written, notes=notes, document={**written.document, "notes": notes})


def _write(request: FolderRequest, page: Page, **figures: int) -> Result:
    out = request.out or sibling_path(request.path, ".html")
    with output_path(out, force=request.force, is_folder=False) as partial:
        partial.write_text(render_page(page), encoding="utf-8")
    metrics = {"bytes": out.stat().st_size, **figures}
    return Result(out=out, metrics=metrics, document={"file": out, **metrics})


def _page_of_run(request: WriteReportRequest, run: RunFolder) -> Page:
    section, scenes = section_of(run, anchor="run", title=run.path.absolute().name), dict[str, str]()
    if run.command in WITH_SPACE:
        section = _add_space(section, run, request.roots, scenes, "scene")
    return Page(
        title=f"{run.command} {run.path.absolute().name}",
        state=section.state,
        sentence=section.sentence,
        tables=changes_since(request.against, request.path, has_links=False)[0],
        runs=[replace(section, title="", sentence="")],
        scenes=scenes,
        opens=True,
    )


def write_page_of_runs(
    file: Path,
    *,
    title: str,
    verdict: Verdict,
    runs: Mapping[str, RunFolder],
    tables: Sequence[Table],
    views: Sequence[Picture],
) -> None:
    """Write a page with a verdict, tables, and runs by heading; replace an earlier page.

    views: pictures of a map. The page shows replays in 3-D, or a map if it is the only run.
    """
    scenes, sections = dict[str, str](), list[RunSection]()
    for heading, run in runs.items():
        name = run.path.name
        section = section_of(run, anchor=name, title=heading)
        if run.command == REPLAY or len(runs) == 1:
            section = _add_space(section, run, (), scenes, name)
        if run.command != REPLAY:
            section = replace(section, pictures=views)
        is_said = section.sentence == verdict.sentence
        sections.append(replace(section, sentence="") if is_said else section)
    page = Page(
        title=title,
        state=str(verdict.outcome),
        sentence=verdict.sentence,
        tables=tables,
        runs=sections,
        scenes=scenes,
        opens=len(scenes) == 1,
    )
    _write(FolderRequest(path=file, out=file, force=True), page)


def _add_space(
    section: RunSection, run: RunFolder, roots: tuple[Path, ...], scenes: dict[str, str], name: str
) -> RunSection:
    try:
        scenes[name] = pack(space_of_run(run, roots))
        return replace(section, space=name)
    except SplatCtrlError as error:
        return replace(section, no_space=f"not in 3-D: {error}")


@dataclass(frozen=True, kw_only=True)
class _Job:
    ran: Run
    run: RunFolder | None
    why: str
    is_changed: bool

    @property
    def least(self) -> float:
        """Least clearance [m], infinity without one."""
        metrics = {} if self.run is None else self.run.metrics
        values = [metrics.get(name) for name in ("min_clearance", "min_clearance_true")]
        return min((float(value) for value in values if isinstance(value, int | float)), default=math.inf)


def _page_of_batch(request: WriteReportRequest, batch: BatchFolder, progress: Progress) -> Page:
    changes, changed = changes_since(request.against, request.path, has_links=True)
    jobs = sorted(
        (_job(batch, ran, ran.node in changed) for ran in batch.runs),
        key=lambda job: (job.ran.state == DONE, not job.is_changed, job.ran.outcome in ("passed", ""), job.least),
    )
    replayed = {job.ran.recording for job in jobs if job.ran.command == REPLAY}
    shown = [job for job in jobs if _is_shown(job, is_seen=request.all_scenes and job.ran.recording not in replayed)]
    wanted = [job for job in shown if job.run is not None and job.run.command in WITH_SPACE]
    chosen = {job.ran.node for job in (wanted if request.all_scenes else wanted[:MOST_SCENES])}
    scenes: dict[str, str] = {}
    sections = []
    for number, job in enumerate(shown, start=1):
        progress.log(f"{number} of {len(shown)}: {job.ran.node}")
        sections.append(_section(request, batch, job, scenes, has_space=job.ran.node in chosen))
    unexpected = [job for job in jobs if job.ran.state != DONE]
    linked = {job.ran.node for job in shown}
    versions = sorted({ran.version for ran in batch.runs if ran.version})
    recordings = len({ran.recording for ran in batch.runs})
    return Page(
        title=f"batch {batch.suite}",
        state="failed" if unexpected else "passed",
        sentence=_sentence(jobs, unexpected),
        lines=[f"{recordings} recordings, {len(batch.runs)} jobs; splatctrl {', '.join(versions) or 'unknown'}"],
        tables=[
            *changes,
            *([_list("Not as expected", unexpected, linked)] if unexpected else []),
            *_matrix(batch, jobs, linked),
            replace(_list("All jobs, with time and memory", jobs, linked), is_folded=True),
        ],
        runs=sections,
        pictures=_gallery(jobs, linked),
        scenes=scenes,
    )


def _gallery(jobs: Sequence[_Job], linked: set[str]) -> list[Picture]:
    shown = {job.ran.recording for job in jobs if job.ran.node in linked and job.run is not None}
    pictures = list[Picture]()
    for command, (name, words) in WITH_PICTURES.items():
        for job in jobs:
            run, recording = job.run, job.ran.recording
            if run is None or run.command != command or recording in shown or len(pictures) == MOST_PICTURES:
                continue
            files = [path for path in run.pictures() if name in path.stem]
            shown |= {recording} if files else set()
            pictures += [picture(path, f"{job.ran.node}: {words}", PICTURE_WIDTH) for path in files[:1]]
    return pictures


def _sentence(jobs: Sequence[_Job], unexpected: Sequence[_Job]) -> str:
    count = len(jobs) - len(unexpected)
    if not unexpected:
        damaged = dict.fromkeys(job.ran.recording for job in jobs if job.ran.damage)
        return f"all {count} jobs as expected" + (f"; {DAMAGE}: {', '.join(damaged)}" if damaged else "")
    ran = unexpected[0].ran
    sentence = ran.sentence or ran.cause or ran.state
    return f"{len(unexpected)} of {len(jobs)} jobs not as expected; first {ran.node}: {sentence}"


def _job(batch: BatchFolder, ran: Run, is_changed: bool) -> _Job:
    run, why = None, ""
    if ran.out and ran.outcome:  # else it only prints, or left nothing
        try:
            place = batch.inside(ran.out)
            if (place / "run.json").is_file() or ran.command == REPLAY:
                run = replace(open_run(place), words=tuple(map(str, json.loads(ran.words))))
        except InputError as error:
            why = str(error)
    return _Job(ran=ran, run=run, why=why, is_changed=is_changed)


def _is_shown(job: _Job, *, is_seen: bool) -> bool:
    if is_seen and job.ran.command == "reconstruct" and job.run is not None:
        return True
    if job.ran.state in ("skipped", "to do"):  # without a run
        return job.is_changed
    return job.ran.command == REPLAY or job.ran.state != DONE or job.is_changed


def _section(
    request: WriteReportRequest, batch: BatchFolder, job: _Job, scenes: dict[str, str], *, has_space: bool
) -> RunSection:
    ran, run = job.ran, job.run
    if run is None:
        return RunSection(
            anchor=ran.node,
            title=ran.node,
            state=ran.state,
            sentence=ran.sentence or ran.cause or ran.state,
            lines=[f"expected: {ran.expect}", *([job.why] if job.why else [])],
            details=[_log(batch, ran)],
        )
    most, width = (3, 800) if has_space else (1, 640)  # number, and width [px]
    section = section_of(run, anchor=ran.node, title=ran.node, most_pictures=most, width=width)
    if ran.state != DONE:
        section = replace(
            section,
            state=ran.state,
            lines=[f"expected: {ran.expect}", *([ran.cause] if ran.cause else []), *section.lines],
            details=[*section.details, _log(batch, ran)],
        )
    if not has_space:
        return replace(section, no_space="not in 3-D: --all-scenes has it" if run.command in WITH_SPACE else "")
    return _add_space(section, run, (batch.path, *request.roots), scenes, f"scene-{len(scenes)}")


def _matrix(batch: BatchFolder, jobs: Sequence[_Job], linked: set[str]) -> list[Table]:
    nodes = {(job.ran.recording, job.ran.column): job.ran for job in jobs}
    recordings = dict.fromkeys(job.ran.recording for job in jobs)
    names = columns_of(((ran.job, ran.column) for ran in batch.runs), batch.jobs)
    rows = [
        ([recording, *(_cell(nodes.get((recording, name)), linked) for name in names)], "")
        for recording in recordings
    ]
    table = Table(title="Recordings", header=("recording", *(name.replace("+", " +") for name in names)))
    more = replace(table, title=f"{len(rows) - MOST_ROWS} more recordings", rows=rows[MOST_ROWS:], is_folded=True)
    return [replace(table, rows=rows[:MOST_ROWS]), *([more] if more.rows else [])]


def _cell(ran: Run | None, linked: set[str]) -> Cell:
    if ran is None:
        return Cell(text="-")
    state = ran.outcome if ran.state == DONE and ran.outcome else ran.state
    is_expected = ran.state == DONE and ran.outcome != PASSED
    words = f"{ran.label or ran.state}{ran.damage}{', as expected' if is_expected else ''}"
    return Cell(text=words, state="" if is_expected else state, link=ran.node if ran.node in linked else "")


def _list(title: str, jobs: Sequence[_Job], linked: set[str]) -> Table:
    rows = [
        (
            (
                Cell(text=job.ran.node, link=job.ran.node if job.ran.node in linked else ""),
                f"{job.ran.label or job.ran.state}{job.ran.damage}",
                job.ran.expect,
                None if job.least == math.inf else round(1e3 * job.least, 1),
                job.ran.sentence or job.ran.cause,
                job.ran.seconds or None,
                job.ran.peak_mb or None,
            ),
            job.ran.state,
        )
        for job in jobs
    ]
    return Table(title=title, header=("job", "verdict", "expected", "least mm", "sentence", "s", "MB"), rows=rows)


def _log(batch: BatchFolder, ran: Run) -> Table:
    try:
        lines = batch.inside(ran.log).read_text(encoding="utf-8", errors="replace").splitlines()
    except (OSError, InputError):
        lines = ["no log"]
    return Table(title="Log", text="\n".join(lines[-12:]))


def view(request: ViewRequest) -> Result:
    """Write a 3-D page; metrics: bytes, num_splats, num_states, num_unknown (cubes of unobserved space).

    Raises InputError if there is nothing to show.
    """
    space = space_of(request.path, request.roots)
    name = request.path.absolute().name
    page = Page(
        title=name,
        state="",
        sentence="",
        runs=[RunSection(anchor="scene", title="", state="", sentence="", space="scene")],
        scenes={"scene": pack(space)},
        opens=True,
    )
    return _write(
        request,
        page,
        num_splats=max(map(len, space.splats.values()), default=0),
        num_states=0 if space.motion is None else len(space.motion.seconds),
        num_unknown=sum(len(points) for points, _ in space.unknown.values()),
    )
