"""A query from its request to its result: distances and more at the points of a table, from a field or a scene."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from io import TextIOWrapper
from pathlib import Path
from typing import TextIO

import numpy as np
from tqdm import tqdm

from splatctrl_cli.config import Config
from splatctrl_cli.config.fixed import CARD_LEAST_TABLE
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.field.grid_cells import check_room
from splatctrl_cli.field.obstacles import DEFAULT_LABELS, obstacle_spheres
from splatctrl_cli.files.output import Parts, Stopwatch, output_path
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.ply import point_blocks
from splatctrl_cli.formats.scene.scene_folder import run_value
from splatctrl_cli.jobs.bake.request import BakeSource, read_bake_source, source_of_grid
from splatctrl_cli.jobs.query.point_answers import TITLES, Answers, GridAnswers, SceneAnswers, rows_of
from splatctrl_cli.jobs.running.device import CUDA, TO_CPU, Device, RunOptions, chosen, named
from splatctrl_cli.jobs.running.progress import SILENT, Progress, Wait
from splatctrl_cli.kernels.cuda.memory import DeviceError
from splatctrl_cli.records import Box, DistanceGrid, Float64, Label
from splatctrl_cli.voxels import VoxelState

STANDARD_INPUT = "standard input"
OF_GRID = {  # settings of the field by the name that a grid's header gives them
    "distance": ("distance", str),
    "length_scale": ("length_scale", float),
    "noise": ("noise", float),
    "weights": ("weights", str),
    "truncation": ("truncation_bound", float),
}


@dataclass(frozen=True, kw_only=True)
class QueryRequest(RunOptions):
    """One table of points to ask `source`, a field folder, a ``field.npz``, a scene folder or a file of splats.

    points: a CSV file with columns x, y, z [m], world, or an open text. out: the CSV of the answers, None for the
    figures alone. scene: of a field, the scene that it was baked from, which knows what the grid does not. at: the
    scene as known that long after its start [s], None for its end. labels: of the splats that count; of a field those
    that it was baked of. device: where a scene's distances are computed, as of --device.
    """

    source: Path
    points: Path | TextIO
    out: Path | None = None
    scene: Path | None = None
    at: float | None = None
    labels: frozenset[Label] = DEFAULT_LABELS


@dataclass(frozen=True, kw_only=True)
class QueryResult:
    """kind: scene, field, or field and scene. metrics: num_points, num_answered (with a distance), num_outside the
    box, num_in_collision (at a distance of 0 or less), num_never_seen (None where it is not known), min_distance,
    mean_distance and min_bound [m], None without any. notes: what a person should know; seconds: of each stage.
    """

    out: Path | None
    kind: str
    metrics: Mapping[str, float | None]
    notes: tuple[str, ...]
    seconds: Mapping[str, float]


def query(request: QueryRequest, progress: Progress = SILENT) -> QueryResult:
    """Answer the points, and write the answers where they are asked for.

    Raises SplatCtrlError for a source or a table that cannot be read or answered, and then leaves no file.
    """
    stopwatch, figures = Stopwatch(), _Figures()
    with ExitStack() as stack:
        out: TextIO | None = None
        if request.out is not None:
            partial = stack.enter_context(output_path(request.out, force=request.force, is_folder=False))
            out = stack.enter_context(partial.open("w", encoding="utf-8", newline=""))
            out.write(",".join(TITLES) + "\n")
        with stopwatch.stage("read"):
            asked = _asked(request, progress)
        with stopwatch.stage("answer"):
            for points in _blocks(request.points, progress):
                try:
                    answers = asked.at(points)
                except DeviceError as error:
                    raise named(error, asked.device) from error
                figures.add(answers)
                if out is not None:
                    out.write(rows_of(points, answers))
    return QueryResult(
        out=request.out,
        kind=asked.kind,
        metrics=figures.metrics(),
        notes=figures.notes(asked),
        seconds=stopwatch.seconds,
    )


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What answers: its kind, its box where it has one, whether it is a grid, which has no distance outside, and the
    device of a scene.
    """

    kind: str
    at: Callable[[Float64], Answers]
    box: Box | None
    is_grid: bool = False
    device: Device | None = None


def _asked(request: QueryRequest, progress: Progress) -> _Asked:
    file = _grid_file(request.source)
    if file is None:
        if request.scene is not None:
            raise UsageError(
                f"--scene: belongs to a field, and {request.source} is a scene", remedy="leave --scene out"
            )
        source = read_bake_source(request.source, request.at)
        device = chosen(request.device, _is_enough(request.points), progress)
        scene = _scene(source, request, request.labels, request.config, device)
        return _Asked(kind="scene", at=scene.at, box=source.workspace, device=device)
    if request.at is not None:
        raise UsageError(f"--at: {request.source} is a field of one time", remedy="give the scene, or leave --at out")
    check_room(str(file), file.stat().st_size, "bake a smaller --box or a larger --voxel")
    grid = read_npz(Parts.beside(file).checked(file))
    of_grid = GridAnswers(grid, str(file))
    if request.scene is None:
        if request.device.startswith(CUDA):
            raise UsageError(f"--device {request.device}: a baked field is read on the processor", remedy=TO_CPU)
        return _Asked(kind="field", at=of_grid.at, box=of_grid.box, is_grid=True)
    where = str(request.source)
    labels, config = _labels_of(grid, where), _config_of(grid, request.config, where)
    device = chosen(request.device, _is_enough(request.points), progress)
    both = _scene(source_of_grid(where, grid, request.scene), request, labels, config, device)

    def at(points: Float64) -> Answers:
        return both.beside(points, of_grid.at(points))

    return _Asked(kind="field and scene", at=at, box=of_grid.box, is_grid=True, device=device)


def _is_enough(points: Path | TextIO) -> bool:
    """Whether as many points are known of as a card pays for."""
    return isinstance(points, Path) and points.is_file() and points.stat().st_size >= CARD_LEAST_TABLE


def _grid_file(source: Path) -> Path | None:
    """The ``field.npz`` of a field; None for what is to be a scene. Raises InputError for a field without one."""
    if source.is_file() and source.suffix == ".npz":
        return source
    file = source / "field.npz"
    if file.is_file():
        return file
    if (source / "field.json").is_file():
        raise InputError(f"{source}: a field without field.npz", remedy="bake it with --formats npz")
    return None


def _scene(
    source: BakeSource, request: QueryRequest, labels: frozenset[Label], config: Config, device: Device
) -> SceneAnswers:
    obstacles = obstacle_spheres(source.splats, source.unrepresented, labels)
    return SceneAnswers(source, obstacles, config, request.threads, device.memory)


def _labels_of(grid: DistanceGrid, where: str) -> frozenset[Label]:
    """Of the splats that the grid was baked of."""
    return run_value(grid.header, ("labels",), lambda names: frozenset(_LABELS[name] for name in names), where=where)


_LABELS = {label.name.lower(): label for label in Label}


def _config_of(grid: DistanceGrid, config: Config, where: str) -> Config:
    """The configuration with the field that the grid was baked with."""
    baked = {name: run_value(grid.header, (key,), kind, where=where) for name, (key, kind) in OF_GRID.items()}
    return replace(config, field=replace(config.field, unknown="free", **baked))


def _blocks(points: Path | TextIO, progress: Progress) -> Iterator[Float64]:
    """The points of a table; a bar shows how much of a file is read."""
    hidden = True if progress.is_quiet else None
    if not isinstance(points, Path):
        with tqdm(unit=" points", disable=hidden) as bar:
            for block in point_blocks(points, STANDARD_INPUT):
                yield block
                bar.update(len(block))
        return
    try:
        raw = points.open("rb")
    except FileNotFoundError:
        raise InputError(f"{points}: no such file", remedy="give a CSV file with the columns x,y,z [m]") from None
    size = points.stat().st_size
    text = TextIOWrapper(raw, encoding="utf-8", newline="")
    with text, tqdm(total=size, unit="B", unit_scale=True, disable=hidden) as bar:
        wait = Wait(progress, f"answers {points}", "bytes", size)
        for block in point_blocks(text, str(points)):
            yield block
            bar.update(raw.tell() - bar.n)
            if bar.disable:
                wait.at(raw.tell())


class _Figures:
    """Counts and extremes over the blocks."""

    def __init__(self) -> None:
        self._num = dict.fromkeys(("points", "outside", "answered", "in_collision", "never_seen"), 0)
        self._sum, self._least, self._least_bound = 0.0, np.inf, np.inf
        self._knows_seen = True

    def add(self, answers: Answers) -> None:
        """Count a block."""
        distance = answers.distance[~np.isnan(answers.distance)]
        self._num["points"] += len(answers.distance)
        self._num["answered"] += len(distance)
        self._num["in_collision"] += int(np.count_nonzero(distance <= 0))
        if answers.in_box is not None:
            self._num["outside"] += int(np.count_nonzero(~answers.in_box))
        if answers.observed is None:
            self._knows_seen = False
        else:
            self._num["never_seen"] += int(np.count_nonzero(answers.observed == VoxelState.NEVER_SEEN))
        self._sum += float(distance.sum())
        self._least = min(self._least, float(distance.min(initial=np.inf)))
        if answers.bound is not None:
            bounds = answers.bound[~np.isnan(answers.bound)]
            self._least_bound = min(self._least_bound, float(bounds.min(initial=np.inf)))

    def metrics(self) -> dict[str, float | None]:
        """As `QueryResult` has them."""
        num = self._num
        return {
            "num_points": num["points"],
            "num_answered": num["answered"],
            "num_outside": num["outside"],
            "num_in_collision": num["in_collision"],
            "num_never_seen": num["never_seen"] if self._knows_seen else None,
            "min_distance": self._least if num["answered"] else None,
            "mean_distance": self._sum / num["answered"] if num["answered"] else None,
            "min_bound": self._least_bound if np.isfinite(self._least_bound) else None,
        }

    def notes(self, asked: _Asked) -> tuple[str, ...]:
        """On points without a distance, and on those that no camera saw."""
        num, notes = self._num, []
        if num["outside"] and asked.box is not None:
            lower, upper = (", ".join(f"{x:.4g}" for x in corner) for corner in (asked.box.lower, asked.box.upper))
            place = f"outside the box ({lower}) to ({upper}) m of the {asked.kind.partition(' ')[0]}"
            what = "have no distance; bake a larger --box" if asked.is_grid else "were never seen; ask inside it"
            notes.append(f"{num['outside']} of {num['points']} points lie {place} and {what}")
        blank = num["points"] - num["answered"] - (num["outside"] if asked.is_grid else 0)
        if blank:
            notes.append(f"{blank} points lie beside never-seen cells, which were baked as nan, and have no distance")
        if self._knows_seen and num["never_seen"]:
            notes.append(
                f"{num['never_seen']} of {num['points']} points are where no camera looked: nothing is known of"
                " obstacles there; scan it, or count it as an obstacle (sdf-bake --unknown obstacle)"
            )
        return tuple(notes)
