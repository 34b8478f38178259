"""A query: answers of a field or scene at points of a table."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from splatctrl_cli.config import Config
from splatctrl_cli.config.fixed import CARD_LEAST_TABLE, MARCH_STEPS
from splatctrl_cli.control.audit import observed_at
from splatctrl_cli.errors import UsageError, refuse_faults, refuse_if
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.field.clusters import DEFAULT_LABELS, ObstacleSpheres, Spheres, obstacle_spheres
from splatctrl_cli.field.distance import PROBABILITIES, OnDevice, SphereField, field_over, march
from splatctrl_cli.field.grid_cells import GridField, check_room
from splatctrl_cli.files.output import Parts, Stopwatch, output_path
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.ply import point_blocks
from splatctrl_cli.formats.scene.scene_folder import run_value
from splatctrl_cli.jobs.bake.request import BakeSource, read_bake_source, source_of_grid
from splatctrl_cli.jobs.running.device import CUDA, TO_CPU, Device, RunOptions, choose_device, explain_faults
from splatctrl_cli.jobs.running.progress import SILENT, Progress, Wait
from splatctrl_cli.kernels.cuda.memory import Memory
from splatctrl_cli.records import Bool, Box, DistanceField, DistanceGrid, Float64, Label
from splatctrl_cli.voxels import VoxelState

TITLES = (
    *("x", "y", "z", "in_box", "distance", "gradient_x", "gradient_y", "gradient_z", "bound", "probability"),
    *("label", "splat", "observed", "surface_x", "surface_y", "surface_z", "surface_rest"),
)
_LABELS = np.array([*(label.name.lower() for label in sorted(Label)), ""])  # the last for -1
_STATES = np.array([*(state.name.lower() for state in sorted(VoxelState)), ""])
_NAMES = {"label": _LABELS, "observed": _STATES}
_DECIMALS = 7  # of a length [m]: finer than float32


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Answers at Q points, world; None if unavailable, NaN or -1 without an answer.

    in_box (Q,): in the source's box. distance (Q,) [m], gradient (Q, 3). bound (Q,) [m]: lower bound of the exact
    distance to the splats. probability (Q,) of collision. label (Q,): `Label` of the nearest sphere; splat (Q,): its
    file index. observed (Q,) `VoxelState`. surface (Q, 3) [m]: end of sphere marching; rest (Q,) [m]: the field's
    value there.
    """

    in_box: Bool | None = None
    distance: Float64
    gradient: Float64
    bound: Float64 | None = None
    probability: Float64 | None = None
    label: NDArray[np.int8] | None = None
    splat: NDArray[np.int64] | None = None
    observed: NDArray[np.int8] | None = None
    surface: Float64 | None = None
    rest: Float64 | None = None


def scene_answers(
    source: BakeSource, obstacles: ObstacleSpheres, config: Config, threads: int, device: Memory | None = None
) -> Callable[..., Answers]:
    """Return a function that answers from splats and balls around unrepresented voxels.

    It queries the field of `config` at points (Q, 3) [m], world. Given a grid's answers, it completes them, with the
    probability at the grid's distance. Raises UsageError unless `field.unknown` is free: only a grid knows unobserved
    space.
    """
    refuse_if(
        config.field.unknown != "free",
        f"field.unknown = {config.field.unknown}: only a baked field has it",
        remedy="bake it with sdf-bake and query that",
        error=UsageError,
    )
    splats, known, limits = obstacles.splats, source.occupancy, config.occupancy
    spheres = Spheres.of(splats.centers, splats.radii)
    exact: SphereField | OnDevice
    field: DistanceField
    if device is None:
        exact, field = SphereField(spheres, threads=threads), field_over(spheres, config.field, threads=threads)
    else:
        exact = OnDevice(spheres, replace(config.field, distance="hard"), device)
        field = OnDevice(spheres, config.field, device, threads=threads)
    probability = PROBABILITIES[config.field.probability](spheres, config.field, threads)
    reach = float(np.abs(splats.centers - spheres.anchor).max())
    states_at = None
    if known is not None:
        states = known.states(limits.free_below, limits.occupied_above)
        states_at = partial(observed_at, states, known.origin, known.voxel)

    def at(points: Float64, of_grid: Answers | None = None) -> Answers:
        distance, gradient = field.query(points)
        nearest = exact.nearest(points)
        surface, rest, _ = march(field, exact, points, steps=MARCH_STEPS)
        size = reach + np.abs(points - spheres.anchor).max(axis=1)
        answers = Answers(
            in_box=None if source.workspace is None else source.workspace.contains(points),
            distance=distance,
            gradient=gradient,
            # what float32 may lose of an exact distance, as in a baked bound
            bound=exact.query(points)[0] - 1e-6 * (1.0 + size),
            probability=probability.at(points, distance),
            label=splats.labels[nearest].astype(np.int8),
            splat=obstacles.index[nearest],
            observed=None if states_at is None else states_at(points).astype(np.int8),
            surface=surface,
            rest=rest,
        )
        if of_grid is None:
            return answers
        at_grid = probability.at(points, of_grid.distance)
        return replace(
            answers,
            in_box=of_grid.in_box,
            distance=of_grid.distance,
            gradient=of_grid.gradient,
            bound=of_grid.bound,
            probability=np.where(np.isnan(of_grid.distance), np.nan, at_grid),
        )

    return at


def grid_answers(grid: DistanceGrid, where: str) -> tuple[Box, Callable[[Float64], Answers]]:
    """Box of a baked grid's cell centres, and a function that answers points (Q, 3) [m], world.

    Points outside have no answer. Distances are interpolated, labels and observations those of the nearest cell.
    Raises InputError for a grid unfit for `GridField`, and unknown labels or states.
    """
    field, has_bound = GridField(grid), "bound" in grid.channels
    of_probability = GridField(grid, "probability") if "probability" in grid.channels else None
    cells = {name: grid.channels[name].astype(np.uint8) for name in _NAMES.keys() & grid.channels.keys()}
    for name, values in cells.items():
        most = len(_NAMES[name]) - 2
        refuse_if(
            values.max() > most,
            f"{where}: {name}: expected 0 to {most}, got {values.max()}",
            remedy="bake the field again",
        )

    def at(points: Float64) -> Answers:
        inside = field.box.contains(points)
        distance, gradient = field.query(points)
        probability = None if of_probability is None else of_probability.query(points)[0]
        nearest = {
            name: np.where(inside, observed_at(values, grid.origin, grid.voxel, points), -1).astype(np.int8)
            for name, values in cells.items()
        }
        return Answers(
            in_box=inside,
            distance=np.where(inside, distance, np.nan),
            gradient=np.where(inside[:, None], gradient, np.nan),
            bound=np.where(inside, field.certified(points), np.nan) if has_bound else None,
            probability=None if probability is None else np.where(inside, probability, np.nan),
            label=nearest.get("label"),
            observed=nearest.get("observed"),
        )

    return field.box, at


def rows_of(points: Float64, answers: Answers) -> str:
    """CSV lines with a cell for each of `TITLES`, empty where unknown."""
    length, a = f"%.{_DECIMALS}f", answers
    # rounded down, it is still a bound
    bound = None if a.bound is None else np.floor(a.bound * 10**_DECIMALS) / 10**_DECIMALS
    columns: list[tuple[str, NDArray[np.generic] | None]] = [
        *(("%.9g", points[:, axis]) for axis in range(3)),
        ("%d", a.in_box),
        (length, a.distance),
        *(("%.6f", a.gradient[:, axis]) for axis in range(3)),
        (length, bound),
        ("%.6g", a.probability),
        ("%s", None if a.label is None else _LABELS[a.label]),
        ("%s", None if a.splat is None else np.where(a.splat < 0, "", a.splat.astype(str))),
        ("%s", None if a.observed is None else _STATES[a.observed]),
        *((length, None if a.surface is None else a.surface[:, axis]) for axis in range(3)),
        (length, a.rest),
    ]
    template = ",".join("" if values is None else form for form, values in columns) + "\n"
    cells = [values.tolist() for _, values in columns if values is not None]
    return "".join(map(template.__mod__, zip(*cells, strict=True))).replace("nan", "")


OF_GRID = {  # field settings: name and type in a grid's header
    "distance": ("distance", str),
    "length_scale": ("length_scale", float),
    "noise": ("noise", float),
    "weights": ("weights", str),
    "truncation": ("truncation_bound", float),
}


@dataclass(frozen=True, kw_only=True)
class QueryRequest(RunOptions):
    """Table of points for `source`: a field folder, ``field.npz``, scene folder or splat file.

    points: a CSV with columns x, y, z [m], world, or an open text. out: None for figures only. scene: the field's
    source, for answers that the grid lacks. at: time after the scene's start [s], None for its end. labels: of splats
    that count.
    """

    source: Path
    points: Path | TextIO
    out: Path | None = None
    scene: Path | None = None
    at: float | None = None
    labels: frozenset[Label] = DEFAULT_LABELS


def query(request: QueryRequest, progress: Progress = SILENT) -> Result:
    """Answer the points, and write to `out`.

    Metrics: num_points, num_answered (with a distance), num_outside (the box), num_in_collision, num_never_seen, and
    min_distance, mean_distance, min_bound [m]. They are None if unknown. The document's source is scene, field, or
    field and scene.

    Raises SplatCtrlError, leaving no file, for an unreadable source or table.
    """
    stopwatch, figures = Stopwatch(), list[dict[str, Any]]()
    with ExitStack() as stack:
        out: TextIO | None = None
        if request.out is not None:
            partial = stack.enter_context(output_path(request.out, force=request.force, is_folder=False))
            out = stack.enter_context(partial.open("w", encoding="utf-8", newline=""))
            out.write(",".join(TITLES) + "\n")
        with stopwatch.stage("read"):
            kind, answer, box, device = _open_source(request, progress)
        with stopwatch.stage("answer"):
            for points in _blocks(request.points, progress):
                with explain_faults(device):
                    answers = answer(points)
                figures.append(_figures_of(answers))
                if out is not None:
                    out.write(rows_of(points, answers))
    metrics = _metrics_of(figures)
    notes, out_name = _notes_of(kind, box, metrics), None if request.out is None else str(request.out)
    document = {"out": out_name, "source": kind, **metrics, "notes": notes}
    return Result(out=request.out, metrics=metrics, document=document, notes=notes, seconds=stopwatch.seconds)


Answering = tuple[str, Callable[[Float64], Answers], Box | None, Device | None]
"""The kind of a source, its answers at points (Q, 3), its box, and the device that computes."""


def _open_source(request: QueryRequest, progress: Progress) -> Answering:
    file = _grid_file(request.source)
    if file is None:
        refuse_if(
            request.scene is not None,
            f"--scene: belongs to a field, and {request.source} is a scene",
            remedy="leave --scene out",
            error=UsageError,
        )
        source = read_bake_source(request.source, request.at)
        device = choose_device(request.device, _is_enough(request.points), progress)
        scene = _scene(source, request, request.labels, request.config, device)
        return "scene", scene, source.workspace, device
    refuse_if(
        request.at is not None,
        f"--at: {request.source} is a field of one time",
        remedy="give the scene, or leave --at out",
        error=UsageError,
    )
    check_room(str(file), file.stat().st_size, "bake a smaller --box or a larger --voxel")
    grid = read_npz(Parts.from_folder(file).checked(file))
    box, of_grid = grid_answers(grid, str(file))
    if request.scene is None:
        refuse_if(
            request.device.startswith(CUDA),
            f"--device {request.device}: a baked field is read on the processor",
            remedy=TO_CPU,
            error=UsageError,
        )
        return "field", of_grid, box, None
    where = str(request.source)
    labels = run_value(
        grid.header, ("labels",), lambda names: frozenset(Label[name.upper()] for name in names), where=where
    )
    baked = {name: run_value(grid.header, (key,), kind, where=where) for name, (key, kind) in OF_GRID.items()}
    config = replace(request.config, field=replace(request.config.field, unknown="free", **baked))
    device = choose_device(request.device, _is_enough(request.points), progress)
    both = _scene(source_of_grid(where, grid, request.scene), request, labels, config, device)
    return "field and scene", lambda points: both(points, of_grid(points)), box, device


def _is_enough(points: Path | TextIO) -> bool:
    return isinstance(points, Path) and points.is_file() and points.stat().st_size >= CARD_LEAST_TABLE


def _grid_file(source: Path) -> Path | None:
    file = source if source.suffix == ".npz" and source.is_file() else source / "field.npz"
    refuse_if(
        not file.is_file() and (source / "field.json").is_file(),
        f"{source}: a field without field.npz",
        remedy="bake it with --formats npz",
    )
    return file if file.is_file() else None


def _scene(
    source: BakeSource, request: QueryRequest, labels: frozenset[Label], config: Config, device: Device
) -> Callable[..., Answers]:
    obstacles = obstacle_spheres(source.splats, source.unrepresented, labels)
    return scene_answers(source, obstacles, config, request.threads, device.memory)


def _blocks(points: Path | TextIO, progress: Progress) -> Iterator[Float64]:
    hidden = True if progress.is_quiet else None
    if not isinstance(points, Path):
        with tqdm(unit=" points", disable=hidden) as bar:
            for block in point_blocks(points, "standard input"):
                yield block
                bar.update(len(block))
        return
    with refuse_faults(
        lambda _: f"{points}: no such file", FileNotFoundError, remedy="give a CSV file with the columns x,y,z [m]"
    ):
        raw = points.open("rb")
    size = points.stat().st_size
    text = TextIOWrapper(raw, encoding="utf-8", newline="")
    with text, tqdm(total=size, unit="B", unit_scale=True, disable=hidden) as bar:
        wait = Wait(progress, f"answers {points}", "bytes", size)
        for block in point_blocks(text, str(points)):
            yield block
            bar.update(raw.tell() - bar.n)
            if bar.disable:
                wait.at(raw.tell())


def _figures_of(answers: Answers) -> dict[str, Any]:
    distance = answers.distance[~np.isnan(answers.distance)]
    bounds = distance[:0] if answers.bound is None else answers.bound[~np.isnan(answers.bound)]
    is_seen_known = answers.observed is not None
    return {
        "num_points": len(answers.distance),
        "num_answered": len(distance),
        "num_outside": 0 if answers.in_box is None else int(np.count_nonzero(~answers.in_box)),
        "num_in_collision": int(np.count_nonzero(distance <= 0)),
        "num_never_seen": int(np.count_nonzero(answers.observed == VoxelState.NEVER_SEEN)) if is_seen_known else None,
        "sum": float(distance.sum()),
        "min_distance": float(distance.min(initial=np.inf)),
        "min_bound": float(bounds.min(initial=np.inf)),
    }


def _metrics_of(figures: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    counts = ("num_points", "num_answered", "num_outside", "num_in_collision")
    num: dict[str, float | None] = {name: sum(each[name] for each in figures) for name in counts}
    seen = [each["num_never_seen"] for each in figures]
    least = {name: min((each[name] for each in figures), default=np.inf) for name in ("min_distance", "min_bound")}
    num_answered = num["num_answered"]
    return {
        **num,
        "num_never_seen": None if None in seen else sum(seen),
        "min_distance": least["min_distance"] if num_answered else None,
        "mean_distance": sum(each["sum"] for each in figures) / num_answered if num_answered else None,
        "min_bound": least["min_bound"] if np.isfinite(least["min_bound"]) else None,
    }


def _notes_of(kind: str, box: Box | None, metrics: Mapping[str, float | None]) -> tuple[str, ...]:
    num, notes = {name: int(value or 0) for name, value in metrics.items() if name.startswith("num_")}, []
    is_grid = kind != "scene"  # which has no distance outside its box
    if num["num_outside"] and box is not None:
        lower, upper = (", ".join(f"{x:.4g}" for x in corner) for corner in (box.lower, box.upper))
        place = f"outside the box ({lower}) to ({upper}) m of the {kind.partition(' ')[0]}"
        what = "have no distance; bake a larger --box" if is_grid else "were never seen; ask inside it"
        notes.append(f"{num['num_outside']} of {num['num_points']} points lie {place} and {what}")
    if blank := num["num_points"] - num["num_answered"] - (num["num_outside"] if is_grid else 0):
        notes.append(f"{blank} points lie next to unseen cells, baked as nan, and have no distance")
    if num["num_never_seen"]:
        notes.append(
            f"{num['num_never_seen']} of {num['num_points']} points are where no camera looked: nothing is known of"
            " obstacles there; scan it, or count it as an obstacle (sdf-bake --unknown obstacle)"
        )
    return tuple(notes)
