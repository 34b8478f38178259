"""A page that shows a scene, a field, splats or a replay in 3-D."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatctrl_cli.files.output import output_path
from splatctrl_cli.jobs.report import beside
from splatctrl_cli.jobs.reports.spaces import space_of
from splatctrl_cli.report.page import Page, RunSection, rendered
from splatctrl_cli.report.viewer import packed


@dataclass(frozen=True, kw_only=True)
class ViewRequest:
    """A page on `path`, a run, scene or field folder, a grid or a file of splats, into `out`, None for PATH.html.

    roots: folders in which the scene and robot of a replay's command line are looked for.
    """

    path: Path
    out: Path | None = None
    roots: tuple[Path, ...] = ()
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class ViewResult:
    """The page, and what is to be seen: splats, states of the arm, cubes of space never seen."""

    file: Path
    bytes: int
    num_splats: int
    num_states: int
    num_unknown: int

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def view(request: ViewRequest) -> ViewResult:
    """Write the page. Raises InputError for what there is nothing to see of."""
    space = space_of(request.path, request.roots)
    name = request.path.absolute().name
    section = RunSection(anchor="scene", title="", state="", sentence="", space="scene")
    page = Page(title=name, state="", sentence="", runs=[section], scenes={"scene": packed(space)}, opens=True)
    out = request.out or beside(request.path)
    with output_path(out, force=request.force, is_folder=False) as partial:
        partial.write_text(rendered(page), encoding="utf-8")
        size = partial.stat().st_size
    return ViewResult(
        file=out,
        bytes=size,
        num_splats=max((len(at.splats) for at in space.splats), default=0),
        num_states=0 if space.motion is None else len(space.motion.seconds),
        num_unknown=0 if space.unknown is None else len(space.unknown),
    )
