"""A simulation: a log of an arm at a table, with its truth."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml import ElementTree

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_json, write_run
from splatctrl_cli.formats.mesh import load_mesh
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.planner.planned import goal_postures
from splatctrl_cli.recording.container.mcap_writer import mcap_log
from splatctrl_cli.recording.folder.dtu import DtuView, write_dtu
from splatctrl_cli.recording.folder.idr import write_idr
from splatctrl_cli.records import Float64, JointState
from splatctrl_cli.robot.coverage import coverage_of_solids
from splatctrl_cli.robot.link_meshes import mesh_path, read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import random_postures
from splatctrl_cli.robot.self_margins import SelfSurfaces
from splatctrl_cli.robot.sphere_files import spheres_yaml
from splatctrl_cli.robot.sphere_fit import default_spheres
from splatctrl_cli.robot.urdf import MeshShape, UrdfFile, read_urdf
from splatctrl_cli.simulate.arm import SHAPES, SLIM, Motion, arm_spheres_yaml, arm_urdf, hand_pose
from splatctrl_cli.simulate.primitives import ALWAYS, Primitive, luminance_std
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions, Scene
from splatctrl_cli.simulate.tabletop import object_mask, turntable_views
from splatctrl_cli.simulate.truth import Truth, distance_along, truth_document


@dataclass(frozen=True, kw_only=True)
class SimulateRequest:
    """Simulation into the folder `out`: log.mcap, truth.json and robot files.

    urdf: another arm, with its base at the world's origin. spheres: None to fit them. is_slim: images show shapes
    inside the collision shapes. unmodelled: `UNMODELLED` parts that only images and truth contain. scene: objects and
    motion instead of the table of `options`. dtu: write a scan, too.
    """

    out: Path = Path("simulated")
    urdf: Path | None = None
    spheres: Path | None = None
    packages: tuple[Path, ...] = ()
    options: RecordingOptions = field(default_factory=RecordingOptions)
    scene: Callable[[RobotModel], Scene] | None = None
    is_slim: bool = False
    unmodelled: tuple[str, ...] = ()
    dtu: bool = False
    force: bool = False

    def __post_init__(self) -> None:
        refuse_if(
            self.urdf is None and self.spheres is not None,
            f"--spheres {self.spheres}: needs the robot",
            remedy="give --urdf as well",
            error=UsageError,
        )
        refuse_if(
            self.urdf is not None and (self.is_slim or self.unmodelled),
            "--slim, --unmodelled: expected the simulated arm, got --urdf",
            error=UsageError,
        )

    @property
    def config(self) -> dict[str, Any]:
        own = {"is_slim": self.is_slim, "unmodelled": self.unmodelled}
        return {**vars(self.options), **{name: value for name, value in own.items() if value}}


@dataclass(frozen=True, kw_only=True, repr=False)
class SimulateResult(Result):
    """Folder and the log's truth; the document adds bytes by file or folder."""

    truth: Truth


def simulate(request: SimulateRequest, progress: Progress = SILENT) -> SimulateResult:
    """Record the scene; equal options give equal bytes."""
    stopwatch = Stopwatch()
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        with stopwatch.stage("log"):
            truth, num_frames = _record(folder, request, progress)
        contrast = truth.luminance_std
        metrics = {
            "frames": num_frames,
            "joint_states": len(truth.stamps),
            "luminance_std": {name: round(value, 4) for name, value in contrast.items()},
            "min_luminance_std": round(min(contrast[c.name] for c in truth.cameras if c.is_training), 4),
            "min_clearance": round(float(truth.clearance.min()), 4),
        }
        write_json(folder / "truth.json", truth_document(truth))
        if request.dtu:
            with stopwatch.stage("dtu"):
                scan = [
                    DtuView(
                        name=frame.camera,
                        color=frame.color,
                        depth=frame.depth,
                        intrinsics=frame.intrinsics,
                        T_world_camera=frame.T_world_camera,
                        mask=object_mask(frame),
                    )
                    for frame in turntable_views()
                ]
                write_dtu(folder / "dtu", "scan1", scan)
                write_idr(folder / "idr", "scan1", scan)
        write_run(
            folder,
            command="simulate",
            config=request.config,
            inputs={} if request.urdf is None else {request.urdf.name: sha256(request.urdf)},
            metrics=metrics,
            stopwatch=stopwatch,
            seed=request.options.seed,
        )
        document = {"out": request.out, "bytes": _sizes(folder), **metrics}
    return SimulateResult(out=request.out, metrics=metrics, document=document, truth=truth)


def _record(folder: Path, request: SimulateRequest, progress: Progress) -> tuple[Truth, dict[str, int]]:
    recording = _recording(folder, request, progress)
    contrast: dict[str, float] = {}
    num_frames = {camera.name: 0 for camera in recording.cameras}
    with mcap_log(folder / "log.mcap") as log:
        log.add_transforms(recording.start_ns, recording.static_transforms(), is_static=True)
        for record in recording.records():
            if isinstance(record, JointState):
                log.add_joint_state(record, recording.robot.joint_names)
                log.add_transforms(record.stamp_ns, recording.link_transforms(record.position), is_static=False)
                continue
            log.add_frame(record)
            contrast[record.camera] = min(contrast.get(record.camera, 1.0), luminance_std(record.color))
            num_frames[record.camera] += 1
            if record.camera == recording.cameras[-1].name and num_frames[record.camera] % 10 == 0:
                progress.log(f"simulate: {(record.stamp_ns - recording.start_ns) / 1e9:.1f} s recorded")
    stamps, clearance = recording.clearances()
    truth = Truth(
        path=folder / "truth.json",
        primitives=recording.primitives,
        cameras=recording.cameras,
        luminance_std=contrast,
        joint_names=recording.robot.joint_names,
        robot_urdf=folder / "robot.urdf",
        robot_spheres=folder / "robot_spheres.yaml",
        T_world_base=recording.robot.T_world_base,
        stamps=stamps,
        clearance=clearance,
        unmodelled=recording.unmodelled,
    )
    return truth, num_frames


def _recording(folder: Path, request: SimulateRequest, progress: Progress) -> Recording:
    options = request.options
    surfaces = None
    if request.urdf is None:
        urdf, spheres = folder / "robot.urdf", folder / "robot_spheres.yaml"
        urdf.write_text(arm_urdf(SLIM if request.is_slim else SHAPES), encoding="utf-8")
        spheres.write_text(arm_spheres_yaml(), encoding="utf-8")
        robot = RobotModel.from_urdf(urdf, spheres)
    else:
        progress.log(f"simulate: reading {request.urdf.name}")
        robot, surfaces = copy_arm(request.urdf, request.spheres, request.packages, folder, progress)
    scene = Scene.of(options) if request.scene is None else request.scene(robot)
    if surfaces is not None and request.scene is None:
        progress.log("simulate: looking for a way through the scene")
        scene = replace(scene, motion=adapt_motion(scene, robot, surfaces))
    return Recording(options, robot, scene, request.unmodelled)


def _sizes(folder: Path) -> dict[str, int]:
    parts = {path: [path, *path.rglob("*")] for path in sorted(folder.iterdir())}
    return {
        path.name if path.is_file() else f"{path.name}/": sum(each.stat().st_size for each in its if each.is_file())
        for path, its in parts.items()
    }


LATE = 1e3  # [rad/s] cost of a second's delay, so large that every way without delay is better
REMEDY = "give the URDF of an arm whose base stands on the table's top"


def copy_arm(
    urdf: Path, sphere_file: Path | None, packages: Sequence[Path], folder: Path, progress: Progress
) -> tuple[RobotModel, SelfSurfaces]:
    """Copy ``robot.urdf``, its ``meshes/`` and ``robot_spheres.yaml`` into a folder and read them.

    Spheres are from `sphere_file`, or fitted. Raises InputError without collision geometry or meshes.
    """
    original = read_urdf(urdf)
    solids = read_solids(original, packages)
    copy = folder / "robot.urdf"
    copy.write_text(_copy_meshes(original, packages, folder, progress), encoding="utf-8")
    spheres = folder / "robot_spheres.yaml"
    if sphere_file is not None:
        shutil.copyfile(sphere_file, spheres)
    else:
        spheres.write_text(spheres_yaml(default_spheres(original, packages)), encoding="utf-8")
    moved = [joint.name for joint in original.joints if joint.kind != "fixed" and joint.name not in original.grippers]
    model = RobotModel.from_urdf(copy, spheres).moved_by(moved)
    model = model.replace_coverage(
        coverage_of_solids(model.urdf, solids, model.sphere_set, resolution=fixed.COVERED_COARSE)
    )
    return model, SelfSurfaces(model, solids)


def adapt_motion(scene: Scene, model: RobotModel, surfaces: SelfSurfaces) -> Motion:
    """Adapt the scene's motion to another arm, whose tip follows the simulated arm's hand.

    The tip is the URDF's last link, its z pointing away from the arm. It may turn about z, and stay nearer to the
    base if out of reach. The way is the shortest clear one, or, if none keeps the velocity limits, the least slowed.
    An arm that fits the original postures keeps the motion. Raises InputError for an unreachable waypoint, or if
    every way collides.
    """
    times, ours = scene.motion.times, scene.motion.waypoints
    if ours.shape[1] == model.num_joints and all(
        np.allclose(model.frame_pose(q, model.frame_names[-1]), hand_pose(q), atol=1e-6) for q in ours
    ):
        return scene.motion
    reached = [_postures(model, hand_pose(q), q) for q in ours]
    costs, before = np.zeros(len(reached[0])), []
    for start, (here, there) in enumerate(pairwise(reached)):
        ways = [Motion(times=times[start : start + 2], waypoints=np.array(ends)) for ends in product(here, there)]
        legs = np.array([_cost(scene, model, surfaces, leg) for leg in ways]).reshape(len(here), len(there))
        before.append(np.argmin(costs[:, None] + legs, axis=0))
        costs = np.min(costs[:, None] + legs, axis=0)
    chosen = [int(np.argmin(costs))]
    refuse_if(
        not np.isfinite(costs[chosen[0]]),
        f"{model.urdf.path}: expected a way between the waypoints, got none",
        remedy=REMEDY,
    )
    for choice in reversed(before):
        chosen.insert(0, int(choice[chosen[0]]))
    return Motion(times=times, waypoints=np.array([postures[k] for postures, k in zip(reached, chosen, strict=True)]))


def _copy_meshes(urdf: UrdfFile, packages: Sequence[Path], folder: Path, progress: Progress) -> str:
    """Copy a URDF's meshes, visual ones as STL; return its text without unreadable visual meshes."""
    root, copies = ElementTree.fromstring(urdf.text), dict[tuple[str, str], str]()
    parts = [(link, part) for link in root.iter("link") for tag in ("collision", "visual") for part in link.iter(tag)]
    for link, part in parts:
        mesh, is_visual = part.find("geometry/mesh"), part.tag == "visual"
        if mesh is None:
            continue
        name = mesh.get("filename", "")
        shape = MeshShape(link=str(link.get("name")), filename=name, scale=(1.0, 1.0, 1.0), T_link_mesh=np.eye(4))
        if (part.tag, name) not in copies:
            try:
                copies[part.tag, name] = _copy(mesh_path(urdf.path, shape, packages), folder, copies, is_visual)
            except InputError as error:
                if not is_visual:
                    raise
                progress.log(f"simulate: {error.message}; link '{shape.link}' is seen by its collision geometry")
                if link.find("collision") is not None:
                    link.remove(part)
                continue
        mesh.set("filename", copies[part.tag, name])
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _copy(source: Path, folder: Path, copies: Mapping[tuple[str, str], str], is_visual: bool) -> str:
    kind = "meshes/visual" if is_visual else "meshes"
    stem = f"{source.stem}.stl" if is_visual else source.name
    name = f"{kind}/{stem}" if f"{kind}/{stem}" not in copies.values() else f"{kind}/{len(copies)}_{stem}"
    (folder / kind).mkdir(parents=True, exist_ok=True)
    if is_visual:
        seen = load_mesh(source)
        trimesh.Trimesh(seen.vertices, seen.faces, process=False).export(folder / name)
    else:
        shutil.copyfile(source, folder / name)
    return name


def _postures(model: RobotModel, T_base_hand: Float64, q: Float64) -> Float64:
    """Find postures (K, J) with the tip at a pose (4, 4), or nearer to the base.

    q: a first guess.
    """
    tip = model.frame_names[-1]
    guesses = [model.middle, *random_postures(model, fixed.SIMULATED_GUESSES, seed=0)]
    if len(q) == model.num_joints:
        guesses.insert(0, np.clip(q, model.lower, model.upper))
    for nearer in fixed.SIMULATED_NEARER ** np.arange(fixed.SIMULATED_NEARINGS):
        postures = [
            posture
            for pose in _turns(T_base_hand, nearer)
            for posture in goal_postures(
                model, tip, pose, np.array(guesses), ControlConfig(), at_most=fixed.SIMULATED_POSTURES
            )
        ]
        if postures:
            return np.array(postures)
    raise InputError(
        f"{model.urdf.path}: expected {tip} to reach ({', '.join(f'{x:.2f}' for x in T_base_hand[:3, 3])}) m "
        "or nearer, pointing down, got no posture",
        remedy=REMEDY,
    )


def _turns(T_base_hand: Float64, nearer: float) -> Iterator[Float64]:
    """Yield poses turned about z, at `nearer` times the distance from the base axis."""
    for angle in 2 * np.pi * np.arange(fixed.SIMULATED_TURNS) / fixed.SIMULATED_TURNS:
        T = T_base_hand.copy()
        c, s = np.cos(angle), np.sin(angle)
        T[:3, :3] = T[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        T[:2, 3] *= nearer
        yield T


def _cost(scene: Scene, model: RobotModel, surfaces: SelfSurfaces, leg: Motion) -> float:
    """Cost of a leg: length [rad], more if close to surfaces or slowed; infinite in collision."""
    slowed = leg.within(model.velocity_limit)
    is_late = slowed.times[-1] > leg.times[-1]
    if is_late and any(primitive.track is not None for primitive in scene.primitives):
        return np.inf
    always = [replace(primitive, from_ns=ALWAYS[0], to_ns=ALWAYS[1]) for primitive in scene.primitives]
    solids: Sequence[Primitive] = always if is_late else scene.primitives
    seconds = np.linspace(leg.times[0], leg.times[-1], fixed.SIMULATED_SAMPLES)
    positions = np.array([leg.at(second)[0] for second in seconds])
    centers = model.sphere_centers_batch(positions)
    moving = model.moving_spheres
    stamps = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    least = float((distance_along(solids, centers[:, moving], stamps) - model.sphere_set.radii[moving]).min())
    if least <= 0 or np.any(surfaces.gaps(positions, centers, 0.0) < 0):
        return np.inf
    shortfall = max(0.0, fixed.SIMULATED_CLEARANCE - least) / fixed.SIMULATED_CLEARANCE
    longer = float(np.ptp(slowed.times) - np.ptp(leg.times))
    length = float(np.linalg.norm(leg.waypoints[1] - leg.waypoints[0]))
    return length + fixed.SIMULATED_SHORTFALL * shortfall + LATE * longer
