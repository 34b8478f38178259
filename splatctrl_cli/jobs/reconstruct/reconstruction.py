"""Fitter over a source's time steps, with outputs and checkpoints."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from splatctrl_cli.calibration.displacement import correct_pose
from splatctrl_cli.config import SceneConfig, fixed
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.formats.ply import read_points
from splatctrl_cli.formats.scene.scene_folder import FORMAT
from splatctrl_cli.formats.scene.scene_writer import Checkpoint, SceneWriter
from splatctrl_cli.jobs.reconstruct.correct_views import Corrections
from splatctrl_cli.jobs.reconstruct.kept_maps import KeptMaps
from splatctrl_cli.jobs.reconstruct.verdict import Reconstructed
from splatctrl_cli.jobs.recordings.open_recording import CameraAgreement, guessed_unit
from splatctrl_cli.jobs.recordings.provenance import first_frame
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.jobs.running.device import CPU, Device, FitDevice, RunOptions
from splatctrl_cli.jobs.running.progress import SILENT, Progress, Wait
from splatctrl_cli.records import Box, Record, RecordSource, RgbdFrame
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.checkpoint import fitter_state, restore_fitter, workspace_of
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.labels import count_carried
from splatctrl_cli.scene.posture import RobotPosture, posture_of
from splatctrl_cli.scene.scale import RecordedDepth, describe_scale, fitted_to
from splatctrl_cli.scene.self_mask import self_mask, self_mask_metrics
from splatctrl_cli.scene.time_steps import AuditRow, TimeStep, cloud_box, depth_box, time_steps

STORED = ("num_read", "is_refined", "first_frames", "corrected")  # attributes a checkpoint stores unchanged


def training_cameras(source: RecordSource) -> list[str]:
    """Cameras that may train. Raises UsageError without any."""
    cameras = [camera for camera in source.cameras if camera != "holdout"]
    refuse_if(
        not cameras,
        f"{source.name}: no camera is left to train on",
        remedy="camera 'holdout' is kept for score",
        error=UsageError,
    )
    return cameras


@dataclass(frozen=True, kw_only=True)
class ReconstructRequest(RobotOptions, RunOptions):
    """Reconstruction of `source` into the folder `out`.

    urdf: the robot to segment from the splats (None: that of the log `recording`). Without `box`, its reach is the
    workspace. points: a coloured cloud to start from. declare: a TOML of carried objects. corrections: of a still
    scene's views. options: other options that decide the bytes, equal in a resumed run.
    """

    source: RecordSource
    out: Path = Path("scene")
    recording: Path | None = None
    urdf: Path | None = None
    self_model: Path | None = None
    box: Box | None = None
    points: Path | None = None
    declare: Path | None = None
    allow_disagreement: bool = False
    corrections: Corrections = field(default_factory=Corrections)
    resume: bool = False
    device: str = CPU
    require: Sequence[str] = ()
    options: Mapping[str, object] = field(default_factory=dict)


class Reconstruction:
    """One run of a request into `folder`, continued from `checkpoint` if given.

    identity: plain values, equal in a continued run. observe: called with every frame of the source. cameras_off:
    `displaced_cameras`, whose poses are corrected.
    """

    def __init__(
        self,
        request: ReconstructRequest,
        robot: RobotModel | None,
        folder: Path,
        *,
        identity: Mapping[str, Any],
        declared: Declarations | None = None,
        checkpoint: Checkpoint | None = None,
        device: FitDevice | None = None,
        observe: Callable[[RgbdFrame], None] | None = None,
        cameras_off: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self._cameras_off = cameras_off or {}
        self.observe, self.device, self.robot = observe, device or FitDevice(), robot
        self.request, self.source, self.config = request, request.source, request.config
        self.cloud = None if request.points is None else read_points(request.points)  # instead of depth
        self.identity = identity
        self.declared = declared or Declarations()
        self._first_state_ns: int | None = None  # declared times are relative to it
        self.cameras = training_cameras(self.source)
        self.writer = SceneWriter(
            folder, {"format": FORMAT, "frame": "world", "units": "m", "source": self.source.name}, checkpoint
        )
        self._maps = KeptMaps(self.writer, self.config)
        self._fitter: SceneFitter | None = None
        self.rows: list[AuditRow] = []
        self.stamps: list[int] = []
        self.repeats: Counter[str] = Counter()  # frames with stale depth, by camera
        self.first_frames: dict[str, dict[str, Any]] = {}  # by camera, to recognise this recording
        self.num_read = 0  # time steps of the source, skipped ones included
        self.is_refined = False
        self.corrected: dict[str, Any] = {}  # corrections of the views
        self._early: TimeStep | None = None  # the first step without a workspace
        self.depth: RecordedDepth | None = None  # depth that chose the map's lengths
        self.agreement = CameraAgreement(
            self.source,
            is_allowed=request.allow_disagreement,
            is_still=not self.source.has_clock,
            guess=guessed_unit(self.source),
        )
        self._saved_at, self._save_time = -float("inf"), 0.0
        request.corrections.check(request.source)
        if checkpoint is not None:
            self._restore(checkpoint)

    @property
    def fitter(self) -> SceneFitter:
        """Fitter, made from the first time step with a workspace."""
        assert self._fitter is not None
        return self._fitter

    def run(self, console: Progress) -> None:
        if self._fitter is not None:
            self.device.give(self.fitter, [view.frame for view in self.fitter.window.newest], console)
        self._step_through(console)
        self.check_found()
        if not self.source.has_clock and not self.is_refined:
            self._refine(self.fitter, console)

    def check_found(self) -> None:
        """Raise InputError if no splat was made so far."""
        if self._fitter is None and self._early is not None:
            self._workspace(self._early)  # raises: there is no depth
        refuse_if(
            self._fitter is None,
            f"{self.source.name}: no frame with colour, depth and pose from camera {', '.join(self.cameras)}",
            remedy="'splatctrl info' says what the input lacks",
        )
        refuse_if(
            not any(row.alive for row in self.rows),
            f"{self.source.name}: no pixel of camera {', '.join(self.cameras)} has a depth inside the workspace",
            remedy="give a --box that holds what the cameras saw; 'splatctrl info' says where they stand",
        )

    def _step_through(self, console: Progress) -> None:
        steps = tqdm(self.time_steps(), disable=True if console.is_quiet else None, unit=" steps")
        for index, step in enumerate(steps):
            if index < self.num_read:
                continue
            row = self.take(step, console)
            if row is None:
                continue
            if index % 10 == 0 and not steps.disable:
                steps.set_postfix(splats=row.alive, dB=row.psnr)
            if steps.disable and index % 10 == 0:
                quality = (
                    "nothing of the workspace in view" if row.psnr is None else f"{row.psnr:.1f} dB on its own views"
                )
                console.log(f"time step {index}: {row.alive} splats, {quality}")
            self._save_if_due()

    def take(self, step: TimeStep, console: Progress) -> AuditRow | None:
        """Process the next time step; None while the workspace is unknown."""
        index, self.num_read = self.num_read, self.num_read + 1
        needs_depth = self.request.box is None and self.robot is None and self.cloud is None  # for the workspace
        if self._fitter is None and not step.has_depth and needs_depth:
            console.log(
                f"time step {index} left out: it has no depth, and the workspace is not known yet; --box sets it"
            )
            self._early = self._early or step
            return None
        for frame in step.frames:
            if frame.camera not in self.first_frames:
                self.first_frames[frame.camera] = first_frame(frame)
        step = replace(step, frames=tuple(correct_pose(frame, self._cameras_off) for frame in step.frames))
        if self._fitter is None:
            self._fit_to(RecordedDepth.of(step.frames), console)
            frames, self.corrected = self.request.corrections.of(
                step.frames, self.source, console, has_robot=self.robot is not None
            )
            step = replace(step, frames=tuple(frames))
        self.agreement.check(step, self.config.occupancy, console)
        if self._fitter is None:
            self._fitter = self._begin(step, console)
            if self.cloud is not None:
                self.fitter.plant(self.cloud)
        elif not self.source.has_clock and self.fitter.num_steps == 1:
            console.log(
                "warning: there are more views than one time step can fit: all seed splats, but only the last refine"
                " them; leave views out, or reconstruct them in parts"
            )
        if not self.source.has_clock and not self.fitter.num_steps:
            what, scene = f"fits {len(step.frames)} views, seeds first", self.config.scene
            self.fitter.descent.heard = Wait(console, what, "iterations", scene.first_iterations).announce().step
        posture = self._posture(step)
        row = self.fitter.step(step.frames, posture)
        if self.fitter.num_steps == 1 and self._grow_budget(row, console):
            self._fitter = self._begin(step, console)
            row = self.fitter.step(step.frames, posture)
        self._count_carried(step, posture)
        self.stamps.extend(frame.stamp_ns for frame in step.frames)
        self._record(row)
        if self.fitter.num_steps == 1 and row.unmet:
            budget = self.config.scene.max_splats
            console.log(
                f"warning: {budget} splats are too few for the first frames: {row.unmet} seeds were dropped; give"
                f" --max-splats {budget + row.unmet}"
            )
        if self.source.has_clock and (self._maps.is_due(index, step.stamp_ns) or self._maps.shows_news(self.fitter)):
            self.snapshot(step.stamp_ns)
        return row

    def _begin(self, step: TimeStep, console: Progress) -> SceneFitter:
        fitter = self._new_fitter(self._workspace(step))
        self.device.give(fitter, step.frames, console)
        return fitter

    def _grow_budget(self, row: AuditRow, console: Progress) -> bool:
        """Enlarge the default splat budget if the first step exceeded it next to a robot."""
        least = SceneConfig().max_splats
        if self.robot is None or not row.unmet or self.config.scene.max_splats != least:
            return False
        budget = min(1000 * math.ceil((1.25 * (least + row.unmet + row.evicted)) / 1000), fixed.MOST_GROWTH * least)
        self.config = self.config.derived(scene=self.config.scene.derived(max_splats=budget))
        console.log(f"{least} splats are too few for the first frames: the budget is now {budget}")
        return True

    def _refine(self, fitter: SceneFitter, console: Progress) -> None:
        total = self.config.scene.refine_iterations
        fitter.descent.heard = Wait(console, "refines", "iterations", total).announce().step
        self._record(fitter.refine(total, lambda _: self._save_if_due()))
        self.snapshot(self.rows[-1].stamp_ns)
        self.is_refined = True

    def finish(self) -> None:
        fitter, stamp_ns = self.fitter, self.rows[-1].stamp_ns
        self.writer.finish(stamp_ns, fitter.splats(), fitter.known_voxels(), fitter.shell_splats())
        self._save(is_last=True)

    def metrics(self) -> dict[str, object]:
        last = self.rows[-1]
        learned = None if self.robot is None else self.robot.self_model
        holding = {part.link for part in learned.temporary} if learned is not None else set[str]()
        return {
            "cameras": self.cameras,
            "devices": self.device.history,
            "has_clock": self.source.has_clock,
            "scale": self.config.scene.scale or 1.0,
            "voxel": self.config.occupancy.voxel,
            "stamp_ns": last.stamp_ns,
            "training_stamps_ns": [] if self.source.has_clock else self.stamps,
            "time_steps": self.fitter.num_steps,
            "iterations": self.fitter.descent.num_iterations,
            "splats": last.alive,
            "robot_splats": last.robot,
            "shell_splats": len(self.fitter.shell_splats() or ()),
            "added": sum(row.added for row in self.rows),
            "relocated": sum(row.relocated for row in self.rows),
            "robot_joints": None if self.robot is None else list(self.robot.joint_names),
            "robot_links": None if self.robot is None else self.robot.extents(),
            "robot_base": None if self.robot is None else self.robot.T_world_base.tolist(),
            "unmet": last.unmet,
            "evicted": sum(row.evicted for row in self.rows),
            "unrepresented_voxels": last.unrepresented,
            "unrepresented_volume": self.fitter.unrepresented.volume,
            "max_unrepresented_voxels": max(row.unrepresented for row in self.rows),
            "loss": last.loss,
            "psnr": last.psnr,
            "background": list(self.fitter.descent.background or (0.0, 0.0, 0.0)),
            "mounted_share": {camera: float(mask.mean()) for camera, mask in self.fitter.mounted.items()},
            "repeated_frames": dict(sorted(self.repeats.items())),
            "frames_without_depth": sum(row.without_depth for row in self.rows),
            "disagreement": self.agreement.disagreement,
            **dict.fromkeys(("pose_residual", "depth_bend", "exposure_spread")),
            **self.corrected,
            "camera_displacement_mm": max((row["distance_mm"] for row in self._cameras_off.values()), default=None),
            "displaced_cameras": dict(self._cameras_off),
            **self_mask_metrics(self.rows, holding),
            "carried": self.declared.carried_uses(),
            "first_frames": list(self.first_frames.values()),
            "workspace": [*self.fitter.workspace.lower.tolist(), *self.fitter.workspace.upper.tolist()],
        }

    def result(self) -> Reconstructed:
        """Input of the criteria of the verdict."""
        learned = () if self.robot is None or self.robot.self_model is None else self.robot.self_model.parts
        return Reconstructed(
            metrics=self.metrics(),
            rows=self.rows,
            config=self.config,
            loss=self.source.loss,
            is_seeded=self.cloud is not None,
            learned=[part.words(self.rows[0].stamp_ns) for part in learned],
        )

    def _record(self, row: AuditRow) -> None:
        self.rows.append(row)
        self.writer.audit(row)

    def snapshot(self, stamp_ns: int) -> None:
        known, thresholds = self.fitter.known_voxels(), self.config.occupancy
        states = known.grid.states(thresholds.free_below, thresholds.occupied_above)
        self.writer.snapshot(stamp_ns, self.fitter.splats(), known, states, self.fitter.shell_splats())

    def _save_if_due(self) -> None:
        period = self.config.scene.checkpoint_period
        # a checkpoint waits 50 times as long as the last one took: below 2 % of the run
        if period > 0 and time.monotonic() < self._saved_at + max(period, 50 * self._save_time):
            return
        start = time.monotonic()
        self._save()
        self._saved_at = time.monotonic()
        self._save_time = self._saved_at - start

    def _save(self, *, is_last: bool = False) -> None:
        progress = {
            "run": self.identity,
            **{name: getattr(self, name) for name in STORED},
            "disagreement": self.agreement.disagreement,
            "depth": None if self.depth is None else asdict(self.depth),
            "devices": self.device.history,
            "stamps": [] if self.source.has_clock else self.stamps,
        }
        self.writer.checkpoint(progress, fitter_state(self.fitter), is_last=is_last)

    def _restore(self, checkpoint: Checkpoint) -> None:
        tuples = ("cameras", "blind")
        self.rows = [
            AuditRow(**row | {name: tuple(row[name]) for name in tuples if name in row})
            for row in self.writer.audited()
        ]
        progress = checkpoint.progress
        for name in (*STORED, "stamps"):
            setattr(self, name, progress[name])
        self.agreement.disagreement = progress["disagreement"]
        self.device.history = progress.get("devices", [{**Device().as_dict(), "from_iteration": 0}])
        depth = progress["depth"]
        self._fit_to(None if depth is None else RecordedDepth(**depth))
        scene = self.config.scene.derived(max_splats=len(checkpoint.state["is_alive"]))
        self.config = self.config.derived(scene=scene)
        self._fitter = self._new_fitter(workspace_of(checkpoint.state))
        restore_fitter(self.fitter, checkpoint.state)

    def time_steps(self) -> Iterator[TimeStep]:
        records, has_clock = self.source.records(), self.source.has_clock
        steps = time_steps(records, self.cameras, has_clock=has_clock, observe=self._see, repeats=self.repeats)
        return steps if self.cloud is None else (step.drop_depth() for step in steps)

    def _see(self, record: Record) -> None:
        if isinstance(record, RgbdFrame):
            if self.observe is not None:
                self.observe(record)
        elif self._first_state_ns is None:
            self._first_state_ns = record.stamp_ns

    def _fit_to(self, depth: RecordedDepth | None, console: Progress = SILENT) -> None:
        """Choose map lengths, or the sensor error, by the first frames with depth."""
        if depth is None:
            return
        self.depth, before = depth, self.config
        self.config = fitted_to(before, depth, has_robot=self.robot is not None)
        if self.config is not before:
            console.log(describe_scale(self.config, depth))

    def _new_fitter(self, workspace: Box) -> SceneFitter:
        scene = self.config.scene if self.source.has_clock else self.config.scene.derived(fill=1.0)
        return SceneFitter(
            scene,
            self.config.occupancy,
            workspace,
            human=self.config.human,
            seed=self.request.seed,
            threads=self.request.threads,
            has_shell=self.robot is not None and scene.shell > 0,
            has_backdrop=self.robot is None and not self.source.has_clock and scene.shell > 0,
        )

    def _workspace(self, first: TimeStep) -> Box:
        if self.request.box is not None:
            return self.request.box
        if self.robot is not None:
            return self.robot.reach_box
        limit, scale = self.config.occupancy.max_range, self.config.scene.scale or 1.0
        return depth_box(first.frames, limit, scale) if self.cloud is None else cloud_box(self.cloud)

    def _posture(self, step: TimeStep) -> RobotPosture | None:
        if self.robot is None or step.position is None:
            return None
        robot, names = self.robot, self.source.joint_names
        at_frames = {stamp_ns: robot.positions_of(names, q) for stamp_ns, q in step.positions.items()}
        carried = self.declared.carried_at(self._seconds(step.stamp_ns)) if self.declared.carried else ()
        return posture_of(robot, robot.positions_of(names, step.position), at_frames, carried)

    def _seconds(self, stamp_ns: int) -> float:
        """Time [s] since the first joint state."""
        assert self._first_state_ns is not None
        return (stamp_ns - self._first_state_ns) * 1e-9

    def _count_carried(self, step: TimeStep, posture: RobotPosture | None) -> None:
        if posture is None or not self.declared.carried or self.robot is None:
            return
        if self.declared.carried_at(seconds := self._seconds(step.stamp_ns)):
            for frame in step.frames:
                mask = self_mask(frame, posture, self.config.occupancy)
                count_carried(self.declared, frame, mask, posture, self.robot.surface_at(step.stamp_ns), seconds)
