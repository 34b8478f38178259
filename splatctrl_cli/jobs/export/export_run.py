"""A replay, a scene or a field as an MCAP of Foxglove's schemas: what was known when, the arm, events, clearances."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import methodcaller
from pathlib import Path

import numpy as np

from splatctrl_cli.control.events import INTERVENTIONS, SHOWN
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import finite, output_path
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import Snapshot, open_scene
from splatctrl_cli.jobs.report.spaces import position_of, robot_bodies, robot_of, scene_of, sets_known, spread
from splatctrl_cli.jobs.runs.run_folder import REPLAY, FolderRequest, RunFolder, States, WrittenFile, open_run
from splatctrl_cli.recording.container.foxglove_writer import FoxgloveLog, foxglove_log

FREE_BELOW, OCCUPIED_ABOVE = 0.3, 0.7  # of snapshots, whose log-odds say nothing finer
CLOUD, SPACE, DISTANCE, TRANSFORMS = "/splats", "/known_space", "/distance", "/tf"
MESHES, EVENTS, CLEARANCE = "/arm", "/events", "/clearance"
Later = tuple[int, int, Callable[[FoxgloveLog], None]]  # stamp [ns], place among those of one stamp, what to write


@dataclass(frozen=True, kw_only=True)
class ExportRunRequest(FolderRequest):
    """One export of `path`, the folder of a replay, a scene or a field, into the MCAP `out`, None for PATH.mcap."""


@dataclass(frozen=True, kw_only=True)
class ExportRunResult(WrittenFile):
    """The file, and how many messages each topic has."""

    messages: dict[str, int]


def export_run(request: ExportRunRequest) -> ExportRunResult:
    """Write the MCAP. Raises InputError for a folder of another kind, and UsageError where a library is missing."""
    parts = sorted(_parts(open_run(request.path), request.roots), key=lambda part: part[:2])
    name = request.path.absolute()
    out = request.out or name.with_name(f"{name.name}.mcap")
    with output_path(out, force=request.force, is_folder=False) as written:
        with foxglove_log(written) as log:
            for _, _, write in parts:
                write(log)
        return ExportRunResult(file=out, bytes=written.stat().st_size, messages=dict(log.counts))


def _parts(run: RunFolder, roots: tuple[Path, ...]) -> Iterator[Later]:
    if run.command == REPLAY:
        if run.states is None:
            raise InputError(f"{run.path}: no steps.csv", remedy="replay again")
        yield from _replay_parts(run, run.states, roots)
    elif (run.path / "field.npz").is_file():
        yield 0, 0, partial(_field, 0, run.parts.checked(run.path / "field.npz"))
    elif (run.path / "splats.ply").is_file():
        yield from _known_parts([(snapshot.stamp_ns, snapshot) for snapshot in open_scene(run.path).snapshots])
    else:
        raise InputError(f"{run.path}: {run.command} leaves nothing to log", remedy="give a replay, scene or field")


def _replay_parts(run: RunFolder, states: States, roots: tuple[Path, ...]) -> Iterator[Later]:
    start = int(states.stamps_ns[0])
    grid = run.option("--field")
    if grid is None:
        known = sets_known(run, states, scene_of(run, roots))
        yield from _known_parts([(start + round(1e9 * time_s), snapshot) for time_s, snapshot in known])
    elif (place := run.place_of(grid, roots)) is not None:
        yield start, 0, partial(_field, start, place / "field.npz" if place.is_dir() else place)
    robot = robot_of(run, states, roots)
    for link, body in robot_bodies(robot).items():
        yield start, 1, methodcaller("add_mesh", f"{MESHES}/{link}", start, link, body.vertices, body.faces)
    for state, stamp in enumerate(states.stamps_ns.tolist()):
        q = position_of(states, robot, state)
        poses = {link: robot.frame_pose(q, link) for link in robot.frame_names}
        clearance = {name: finite(float(values[state])) for name, values in states.clearance.items()}
        yield stamp, 2, methodcaller("add_transforms", TRANSFORMS, stamp, poses)
        yield stamp, 3, methodcaller("add_numbers", CLEARANCE, stamp, clearance)
    yield start, 4, methodcaller("add_line", EVENTS, start, "INFO", str(run.verdict.get("sentence", "")))
    for event in (run.json_of("events.json") or {}).get("events", []):
        if event["source"] in SHOWN:
            level = "INFO" if event["kind"] in INTERVENTIONS else "WARNING"
            words = f"{event['kind']}{SHOWN[event['source']]}: {event['worst_name']}, worst {event['worst']:.4g}"
            told = f"{words} {event['unit']} at {event['worst_s']:.2f} s, until {event['end_s']:.2f} s"
            yield int(event["first_ns"]), 4, methodcaller("add_line", EVENTS, int(event["first_ns"]), level, told)


def _known_parts(known: Sequence[tuple[int, Snapshot]]) -> Iterator[Later]:
    """The splats of every snapshot from a stamp [ns] on, and of a few of them, evenly, what is known of space."""
    few = {known[i][0] for i in spread([1e-9 * (stamp - known[0][0]) for stamp, _ in known], math.inf)}
    for stamp, snapshot in known:
        yield stamp, 0, partial(_cloud, stamp, snapshot)
        if stamp in few:
            yield stamp, 0, partial(_space, stamp, snapshot)


def _cloud(stamp: int, snapshot: Snapshot, log: FoxgloveLog) -> None:
    splats = snapshot.splats()
    x, y, z = splats.centers.T
    shades = np.rint(255 * np.clip(np.column_stack([splats.colors, splats.opacities]), 0.0, 1.0))
    colors = dict(zip(("red", "green", "blue", "alpha"), shades.astype(np.uint8).T, strict=True))
    log.add_cloud(CLOUD, stamp, {"x": x, "y": y, "z": z, "radius": splats.radii, "label": splats.labels, **colors})


def _space(stamp: int, snapshot: Snapshot, log: FoxgloveLog) -> None:
    grid = snapshot.occupancy()
    if grid is not None:
        log.add_voxels(SPACE, stamp, "state", grid.states(FREE_BELOW, OCCUPIED_ABOVE), grid.origin, grid.voxel)


def _field(stamp: int, path: Path, log: FoxgloveLog) -> None:
    grid = read_npz(path)
    log.add_voxels(DISTANCE, stamp, "distance", np.asarray(grid.channels["sdf"]), grid.origin, grid.voxel)
