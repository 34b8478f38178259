"""3-D scenes of runs, scene folders, fields and splat files."""

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_faults, refuse_if, require
from splatctrl_cli.files.output import sha256
from splatctrl_cli.formats.grid.iso_surface import iso_surface
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import MAP_DELAYS, SceneFolder, Snapshot, open_scene
from splatctrl_cli.formats.splat.splats import nearest_splats, read_splats
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.runs.run_folder import REPLAY, RunFolder, States, open_run
from splatctrl_cli.recording.capture.capture import ROBOT
from splatctrl_cli.records import DistanceGrid, Float64, SplatSet
from splatctrl_cli.report.page import Motion, Space, Surface, bodies_of, coarsen
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import sphere_names
from splatctrl_cli.voxels import EvidenceClass, VoxelState

MOST_UNKNOWN = 6000  # cubes of space without evidence
SHELL = {
    EvidenceClass.HIDDEN_BY_ARM: "hidden by the arm",
    EvidenceClass.HIDDEN_BY_THING: "hidden by an object",
    EvidenceClass.OUT_OF_VIEW: "out of view",
    EvidenceClass.NO_RETURN: "no return",
    EvidenceClass.CONTRADICTED: "contradicted",
    EvidenceClass.UNANSWERED: "depth expected, none",
}
PLACE = re.compile(r"at \((-?[\d.]+), (-?[\d.]+), (-?[\d.]+)\)")


def space_of(path: Path, roots: tuple[Path, ...] = ()) -> Space:
    """3-D scene of a run, scene or field folder, splat file or field.

    Raises InputError for anything else, or if a run's scene or robot is missing.
    """
    if not path.is_file():
        return space_of_run(open_run(path), roots)
    if path.suffix == ".npz":
        return space_of_grid(path)
    splats = read_splats(path)[0]
    return Space(splats={0.0: splats if isinstance(splats, SplatSet) else nearest_splats(splats)})


def space_of_run(run: RunFolder, roots: tuple[Path, ...] = ()) -> Space:
    path = run.path
    if run.command == REPLAY:
        return space_of_replay(run, roots)
    if (path / "field.npz").is_file():
        return space_of_grid(run.parts.checked(path / "field.npz"))
    if (path / "splats.ply").is_file():
        return space_of_scene(open_scene(path))
    raise InputError(
        f"{path}: {run.command} leaves nothing to see in 3-D", remedy="give a scene, a field, a replay or splats"
    )


def space_of_scene(scene: SceneFolder) -> Space:
    if scene.is_anisotropic:
        return Space(splats={0.0: nearest_splats(scene.gaussians())})
    return _add_seen(Space(splats={0.0: scene.splats()}), scene, scene)


def space_of_grid(path: Path) -> Space:
    """Zero surface of a baked field, on a thinned grid, and unobserved space."""
    grid = read_npz(path)
    refuse_if("sdf" not in grid.channels, f"{path}: expected the channel sdf, got {', '.join(grid.channels)}")
    step = -(-max(grid.channels["sdf"].shape) // 80)  # cells along a side at most
    thinned = DistanceGrid(
        origin=grid.origin,
        voxel=step * grid.voxel,
        channels={"sdf": np.ascontiguousarray(grid.channels["sdf"][::step, ::step, ::step])},
        header=grid.header,
    )
    try:
        mesh = iso_surface(thinned)
        surface = Surface(vertices=mesh.vertices.astype(np.float32), faces=mesh.faces.astype(np.uint32))
    except NotEvaluableError:
        surface = None
    unknown = {}
    if "observed" in grid.channels:
        is_unknown = np.asarray(grid.channels["observed"]) == VoxelState.NEVER_SEEN
        unknown["never seen"] = coarsen(is_unknown, grid.origin, grid.voxel, MOST_UNKNOWN)
    return Space(surface=surface, unknown=unknown)


def space_of_replay(run: RunFolder, roots: tuple[Path, ...] = ()) -> Space:
    """Replay's scene as known over time, its robot's motion, and the deciding place."""
    states = require(run.states, f"{run.path}: no steps.csv", remedy="replay again")
    robot = robot_of(run, states, roots)
    deciding = _deciding(run, states, robot)
    return replace(_scene_of(run, states, roots, deciding), deciding=deciding, motion=_motion(run, states, robot))


def robot_of(run: RunFolder, states: States, roots: tuple[Path, ...] = ()) -> RobotModel:
    """Robot of a replay, by its command line or log. Raises InputError for missing files."""
    files = {name: run.option(f"--{name}") for name in ("urdf", "spheres")}
    places = {name: _file(run, file, roots) for name, file in files.items() if file is not None}
    if files["urdf"] is None and run.parts.has(run.path / ROBOT):
        places["urdf"] = run.parts.checked(run.path / ROBOT)
    refuse_if(
        "urdf" not in places, f"{run.path}: its command line has no --urdf", remedy="replay with the command line"
    )
    base, word = run.run.get("metrics", {}).get("robot_base"), run.option("--base")
    if base is None and word is not None:  # an earlier version's
        numbers = [float(part) for part in word.split(",")]
        base = transform_from(numbers[:3], numbers[3:])
    locks = tuple((name, float(value)) for name, _, value in (word.partition("=") for word in run.options("--lock")))
    packages = tuple(place for word in run.options("--packages") if (place := run.place_of(word, roots)))
    robot = _robot(
        places["urdf"],
        places.get("spheres"),
        None if base is None else tuple(map(tuple, base)),
        locks,
        packages,
        tuple(sha256(path) for path in places.values()),
    )
    return robot.moved_by(tuple(states.joints))


@lru_cache(maxsize=4)
def _robot(
    urdf: Path,
    spheres: Path | None,
    T_world_base: tuple[tuple[float, ...], ...] | None,
    locks: tuple[tuple[str, float], ...],
    packages: tuple[Path, ...],
    _digests: tuple[str, ...],
) -> RobotModel:
    """Cached: runs of a batch share robots."""
    T = None if T_world_base is None else np.array(T_world_base)
    return RobotModel.from_urdf(urdf, spheres, T_world_base=T, locked=dict(locks), packages=packages)


@lru_cache(maxsize=4)
def robot_bodies(robot: RobotModel) -> dict[str, Surface]:
    return bodies_of(robot.surface)


def _file(run: RunFolder, word: str, roots: tuple[Path, ...]) -> Path:
    inputs: Mapping[str, Any] = run.run.get("inputs", {})
    return require(
        run.place_of(word, roots, inputs.get(Path(word).name)),
        f"{run.path}: {word} of its command line is not found, or was changed since",
        remedy="give the folder that it was relative to with --root",
    )


def _scene_of(run: RunFolder, states: States, roots: tuple[Path, ...], deciding: Mapping[str, Any] | None) -> Space:
    if (grid := run.option("--field")) is not None:
        place = _file(run, grid, roots)
        return space_of_grid(place / "field.npz" if place.is_dir() else place)
    scene = scene_of(run, roots)
    known = sets_known(run, states, scene)
    times, used = [time for time, _ in known], [snapshot for _, snapshot in known]
    when = 0.0 if deciding is None else deciding["time"]
    chosen = spread(times, when)
    sets = {times[i] if n else 0.0: used[i].splats() for n, i in enumerate(chosen)}
    at = max((i for i in chosen if times[i] <= when), default=None)
    return _add_seen(Space(splats=sets), None if at is None else used[at], scene)


def scene_of(run: RunFolder, roots: tuple[Path, ...] = ()) -> SceneFolder:
    """Scene of a replay's command line. Raises InputError if missing."""
    word = run.option("--scene")
    folder = run.path / "scene" if word is None else run.place_of(word, roots)
    scene_folder = require(
        folder if folder is not None and folder.exists() else None,
        f"{run.path}: the scene {word or 'scene/'} of its command line is not found",
        remedy="give the folder that it was relative to with --root",
    )
    return open_scene(scene_folder)


def sets_known(run: RunFolder, states: States, scene: SceneFolder) -> list[tuple[float, Snapshot]]:
    """Snapshots a replay used, each with the motion time [s] at which it became known."""
    latency = float(run.option("--latency") or 0.0)
    delays = scene.run.get("metrics", {}).get(MAP_DELAYS) or [latency] * len(scene.snapshots)
    first, last = int(states.stamps_ns[0]), int(states.stamps_ns[-1])
    known = [(s.stamp_ns + round(1e9 * delay), s) for delay, s in zip(delays, scene.snapshots, strict=True)]
    known = [each for each in known if each[0] <= last] if scene.has_clock else known[-1:]
    num_early = sum(known_ns <= first for known_ns, _ in known)
    return [(max(0.0, 1e-9 * (known_ns - first)), snapshot) for known_ns, snapshot in known[max(0, num_early - 1) :]]


def spread(times: list[float], when: float) -> list[int]:
    """Indices of at most 6 `times`: first, last, newest at `when`, others equally spaced."""
    if not times:
        return []
    at, most = max((i for i, time in enumerate(times) if time <= when), default=0), min(len(times), 5)
    even = np.linspace(0, len(times) - 1, most).round().astype(int).tolist()
    nearest = min(range(most), key=lambda i: abs(even[i] - at))
    if 0 < nearest < most - 1:
        even[nearest] = at
    return sorted({*even, at})


def _add_seen(space: Space, known: SceneFolder | Snapshot | None, scene: SceneFolder) -> Space:
    space = replace(space, cameras=[_camera(row) for row in scene.made_from.get("first_frames", [])])
    seen = None if known is None else known.seen()
    if seen is None:
        return space
    cells = np.indices(seen.last_seen.shape).reshape(3, -1).T
    classes = seen.look(seen.origin + seen.voxel * cells)[1].reshape(seen.last_seen.shape)
    shell = {
        name: coarsen(classes == evidence, seen.origin, seen.voxel, MOST_UNKNOWN // len(SHELL))
        for evidence, name in SHELL.items()
    }
    return replace(space, unknown=shell)


def _camera(first_frame: Mapping[str, Any]) -> dict[str, Any]:
    T, (_, fy, *_, height) = np.reshape(first_frame["T_world_camera"], (4, 4)), first_frame["intrinsics"]
    fov = float(np.degrees(2 * np.arctan(height / (2 * fy))))
    return {"name": first_frame["camera"], "eye": T[:3, 3].tolist(), "ahead": T[:3, 2].tolist(), "fov": fov}


def _motion(run: RunFolder, states: States, robot: RobotModel) -> Motion:
    count = len(states.seconds)
    chosen = set(np.linspace(0, count - 1, min(count, 240)).round().astype(int).tolist())
    worst = states.worst()
    which = sorted(chosen if worst is None else chosen | {worst})
    bodies = robot_bodies(robot)
    end = run.option("--frame") or robot.frame_names[-1]
    postures = [position_of(states, robot, state) for state in which]
    return Motion(
        seconds=states.seconds[which],
        bodies=bodies,
        poses=np.array([[robot.frame_pose(q, link) for link in bodies] for q in postures]),
        path=np.array([robot.frame_pose(q, end)[:3, 3] for q in postures]),
        clearance=states.judged[which],
        margin=float((run.json_of("summary.json") or {}).get("about", {}).get("margin", 0.0)),
    )


def position_of(states: States, robot: RobotModel, state: int) -> Float64:
    """Joint positions (J,) of a state, in the robot's order."""
    with refuse_faults(
        lambda error: f"steps.csv: no column q_{error.args[0]} of the robot's joint", KeyError, remedy="replay again"
    ):
        return np.array([states.joints[name][state] for name in robot.joint_names], np.float64)


def _deciding(run: RunFolder, states: States, robot: RobotModel) -> dict[str, Any] | None:
    for reason in run.verdict.get("reasons", []):
        if reason["outcome"] != "passed" and reason["place"] is not None and reason["time_s"] is not None:
            words = f"{reason['sentence']} at {reason['time_s']:.2f} s, {reason['cause']}"
            return _find_deciding(states, robot, words, float(reason["time_s"]), reason["place"], str(reason["who"]))
    worst = states.worst()
    if worst is None or not states.obstacles or not (place := PLACE.search(states.obstacles[worst])):
        return None
    time_s = float(states.seconds[worst])
    words = f"least clearance {1e3 * states.judged[worst]:.1f} mm at {time_s:.2f} s, near {states.obstacles[worst]}"
    return _find_deciding(states, robot, words, time_s, [float(part) for part in place.groups()], "")


def _find_deciding(
    states: States, robot: RobotModel, words: str, time_s: float, place: list[float], who: str
) -> dict[str, Any]:
    state = int(np.argmin(np.abs(states.seconds - time_s)))
    centers, radii = robot.sphere_centers(position_of(states, robot, state)), robot.sphere_set.radii
    names = sphere_names(robot.sphere_set)
    gaps = np.linalg.norm(centers - np.array(place), axis=1) - radii
    sphere = names.index(who) if who in names else int(np.argmin(np.where(robot.moving_spheres, gaps, np.inf)))
    return {
        "sentence": words,
        "time": time_s,
        "place": np.array(place).tolist(),
        "center": centers[sphere].tolist(),
        "radius": float(radii[sphere]),
    }
