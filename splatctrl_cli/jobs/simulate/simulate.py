"""A simulation from its request to its result: a recorded log of an arm at a table, with its truth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import UsageError
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_json, write_run
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.simulate.simulated_arm import adapted_motion, copied_arm
from splatctrl_cli.recording.container.mcap_writer import mcap_log
from splatctrl_cli.recording.folder.dtu import DtuView, write_dtu
from splatctrl_cli.recording.folder.idr import write_idr
from splatctrl_cli.records import JointState
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import SHAPES, SLIM, arm_spheres_yaml, arm_urdf
from splatctrl_cli.simulate.primitives import luminance_std
from splatctrl_cli.simulate.recording import Recording, RecordingOptions, Scene
from splatctrl_cli.simulate.tabletop import object_mask, turntable_views
from splatctrl_cli.simulate.truth import Truth, truth_document


@dataclass(frozen=True, kw_only=True)
class SimulateRequest:
    """Write log.mcap, truth.json and the robot's files into the folder `out`; dtu: and a scan, in both layouts.

    urdf: of another arm than the simulated one, its base on the table at the world's origin; spheres: that cover it
    (None: fitted); packages: where its meshes are looked for. is_slim: the arm is seen by shapes inside of its
    collision shapes; unmodelled: names of `UNMODELLED` parts that move with it, in images and truth alone.
    scene: what stands there and how the robot moves in it, instead of the table of the options.
    """

    out: Path
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
        if self.urdf is None and self.spheres is not None:
            raise UsageError(f"--spheres {self.spheres}: needs the robot", remedy="give --urdf as well")
        if self.urdf is not None and (self.is_slim or self.unmodelled):
            raise UsageError("--slim, --unmodelled: expected the simulated arm, got --urdf")

    @property
    def config(self) -> dict[str, Any]:
        """Metrics for run.json."""
        own = {"is_slim": self.is_slim, "unmodelled": self.unmodelled}
        return {**vars(self.options), **{name: value for name, value in own.items() if value}}


@dataclass(frozen=True, kw_only=True)
class SimulateResult:
    """The folder, what is true in the log, frames by camera, and bytes of each file or folder in it."""

    out: Path
    truth: Truth
    num_frames: Mapping[str, int]
    sizes: Mapping[str, int]

    @property
    def metrics(self) -> dict[str, Any]:
        return _metrics(self.truth, self.num_frames)


def simulate(request: SimulateRequest, progress: Progress = SILENT) -> SimulateResult:
    """Record the scene; the same options give the same bytes."""
    stopwatch = Stopwatch()
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        with stopwatch.stage("log"):
            truth, num_frames = _record(folder, request, progress)
        write_json(folder / "truth.json", truth_document(truth))
        if request.dtu:
            with stopwatch.stage("dtu"):
                _write_scan(folder)
        write_run(
            folder,
            command="simulate",
            config=request.config,
            inputs={} if request.urdf is None else {request.urdf.name: sha256(request.urdf)},
            metrics=_metrics(truth, num_frames),
            stopwatch=stopwatch,
            seed=request.options.seed,
        )
        return SimulateResult(out=request.out, truth=truth, num_frames=num_frames, sizes=_sizes(folder))


def _record(folder: Path, request: SimulateRequest, progress: Progress) -> tuple[Truth, dict[str, int]]:
    """Write robot files and log; the truth and the number of frames by camera."""
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
    return _truth(folder, recording, contrast), num_frames


def _recording(folder: Path, request: SimulateRequest, progress: Progress) -> Recording:
    """The scene and the arm in it, whose files are written."""
    options = request.options
    surfaces = None
    if request.urdf is None:
        urdf, spheres = folder / "robot.urdf", folder / "robot_spheres.yaml"
        urdf.write_text(arm_urdf(SLIM if request.is_slim else SHAPES), encoding="utf-8")
        spheres.write_text(arm_spheres_yaml(), encoding="utf-8")
        robot = RobotModel.from_urdf(urdf, spheres)
    else:
        progress.log(f"simulate: reading {request.urdf.name}")
        robot, surfaces = copied_arm(request.urdf, request.spheres, request.packages, folder, progress)
    scene = Scene.of(options) if request.scene is None else request.scene(robot)
    if surfaces is not None and request.scene is None:
        progress.log("simulate: looking for a way through the scene")
        scene = replace(scene, motion=adapted_motion(scene, robot, surfaces))
    return Recording(options, robot, scene, request.unmodelled)


def _truth(folder: Path, recording: Recording, contrast: Mapping[str, float]) -> Truth:
    stamps, clearance = recording.clearances()
    return Truth(
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


def _write_scan(folder: Path) -> None:
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


def _sizes(folder: Path) -> dict[str, int]:
    """Bytes of each file, and of each folder's files in all."""
    sizes = {}
    for path in sorted(folder.iterdir()):
        parts = [path] if path.is_file() else [part for part in path.rglob("*") if part.is_file()]
        sizes[path.name if path.is_file() else f"{path.name}/"] = sum(part.stat().st_size for part in parts)
    return sizes


def _metrics(truth: Truth, num_frames: Mapping[str, int]) -> dict[str, Any]:
    training = [camera.name for camera in truth.cameras if camera.is_training]
    return {
        "frames": num_frames,
        "joint_states": len(truth.stamps),
        "luminance_std": {name: round(value, 4) for name, value in truth.luminance_std.items()},
        "min_luminance_std": round(min(truth.luminance_std[name] for name in training), 4),
        "min_clearance": round(float(truth.clearance.min()), 4),
    }
