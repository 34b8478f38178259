"""Recordings corrected by a calibration, or perturbed, as they are read."""

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from splatctrl_cli.calibration.calibration_file import CalibratedCamera, Calibration, read_calibration
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.files.output import sha256
from splatctrl_cli.geometry import compare_poses, interpolate_transform, transform_from
from splatctrl_cli.recording.capture.capture import CaptureSource
from splatctrl_cli.recording.folder.folder_views import HOLDOUT
from splatctrl_cli.recording.log.messages import metres
from splatctrl_cli.recording.log.ros_log import RosLogSource
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source_options import CALIBRATION, PERTURB, SourceOptions
from splatctrl_cli.records import SECOND_NS, Float32, Float64, LossReport, RgbdFrame


@dataclass(frozen=True, kw_only=True)
class Correction:
    """A calibration applied to recording `where`."""

    file: Path
    calibration: Calibration
    where: str

    @property
    def clock_ns(self) -> int:
        """[ns] to add to joint states' stamps; 0 if the clock was not calibrated."""
        return round((self.calibration.clock or 0.0) * SECOND_NS)

    def camera(self, name: str) -> CalibratedCamera:
        """A calibrated camera. Raises InputError for others."""
        cameras = self.calibration.cameras
        if name == HOLDOUT and len(cameras) == 1:  # views of the one camera, held out
            return next(iter(cameras.values()))
        refuse_if(
            name not in cameras,
            f"{self.where}: camera {name} is not in {self.file}, which has {', '.join(cameras)}",
            remedy=f"calibrate it too, or leave it out with --cameras {','.join(cameras)}",
        )
        return cameras[name]

    def pose(self, name: str, T_recorded: Float64) -> Float64:
        """Correct a recorded T_world_camera (4, 4). Raises InputError for another recording's calibration."""
        camera = self.camera(name)
        if camera.recorded is None:
            return T_recorded @ camera.T
        if _same(T_recorded, camera.recorded):
            return camera.T
        refuse_if(
            _same(T_recorded, camera.T),
            f"{self.where}: camera {name} is already where {self.file} puts it",
            remedy="leave --calibration out",
        )
        off = 1e3 * float(np.linalg.norm(T_recorded[:3, 3] - camera.recorded[:3, 3]))
        raise InputError(
            f"{self.where}: camera {name} is not recorded where {self.calibration.recording}, which was calibrated,"
            f" has it ({off:.1f} mm apart)",
            remedy="calibrate this recording: the camera was moved, or its pose was set anew",
        )

    def late_ns(self, name: str) -> int:
        """Delay [ns] of frame stamps against poses; 0 for a fixed camera."""
        return self.clock_ns if self.clock_ns and self.camera(name).moves else 0

    def depth(self, name: str, depth: Float32) -> Float32:
        """Correct depth [m] by the camera's scale and bias; 0 (no return) stays 0."""
        camera = self.camera(name)
        if (camera.scale, camera.bias) == (1.0, 0.0):
            return depth
        return np.maximum(np.where(depth > 0, camera.scale * depth + camera.bias, 0.0), 0.0).astype(np.float32)

    def states(self, states: StateColumns) -> StateColumns:
        """Move states to the frames' clock."""
        return replace(states, stamp_ns=states.stamp_ns + self.clock_ns) if self.clock_ns else states

    def frame(self, frame: RgbdFrame) -> RgbdFrame:
        """Correct a frame whose pose already follows the robot's clock."""
        return replace(
            frame,
            T_world_camera=self.pose(frame.camera, frame.T_world_camera),
            depth=self.depth(frame.camera, frame.depth),
        )

    def changed(self, stored: StoredFrame, T: Float64) -> StoredFrame:
        """The frame with corrected depth, at pose T (4, 4).

        Depth counts stay counts if only their scale changes.
        """
        camera, unit = self.camera(stored.camera), stored.depth_unit
        if (camera.scale, camera.bias) == (1.0, 0.0):
            return replace(stored, T_world_camera=T)
        if unit is None or camera.bias:
            return _replace_depth(stored, T, lambda: self.depth(stored.camera, stored.depth))
        scaled, one = unit * camera.scale, np.float32(unit)
        return replace(
            stored,
            T_world_camera=T,
            read_depth=lambda: metres(np.rint(stored.depth / one).astype(np.uint16), scaled),
            depth_unit=scaled,
        )

    def digests(self) -> dict[str, str]:
        return {f"{CALIBRATION}{self.file.name}": sha256(self.file)}

    def notes(self, digests: Collection[str]) -> list[str]:
        """A report's notes; digests: sha256 of the recording's files."""
        text = f"poses, depths and clock are those of {self.file.name}"
        if set(digests) == set(self.calibration.digests.values()):
            return [text]
        return [f"{text}, which was found of another recording ({self.calibration.recording})"]


def _replace_depth(stored: StoredFrame, T: Float64, read_depth: Callable[[], Float32]) -> StoredFrame:
    return replace(stored, T_world_camera=T, read_depth=read_depth, depth_unit=None, depth_file=None)


def read_correction(options: SourceOptions, where: str) -> Correction | None:
    """The options' correction, or None. Raises InputError for an invalid file."""
    if options.calibration is None:
        return None
    return Correction(file=options.calibration, calibration=read_calibration(options.calibration), where=where)


def calibrated(source: FrameSource, options: SourceOptions) -> FrameSource:
    """The source, corrected, then perturbed by the options.

    Raises InputError for another recording's calibration, UsageError for an invalid perturbation.
    """
    correction, perturbation = read_correction(options, source.name), Perturbation.of(options.perturb)
    if correction is not None:
        refuse_if(
            isinstance(source, CaptureSource) and sha256(correction.file) in source.made_of,
            f"{source.name}: was ingested with {correction.file}",
            remedy="leave --calibration out: it is applied",
        )
        for camera in source.cameras:
            correction.camera(camera)
        unseen = set(source.cameras)
        for _, camera, T in source.poses():
            if camera in unseen:
                correction.pose(camera, T)
            unseen.discard(camera)
            if not unseen:
                break
    changes: list[Correction | Perturbation | None] = [correction, perturbation]
    for change in (change for change in changes if change is not None):
        source = ChangedSource(source, change, round(options.pose_tolerance_s * SECOND_NS))
    return source


class ChangedSource(FrameSource):
    """Another source's records, corrected by a calibration or perturbed, in memory.

    A calibrated clock shifts joint states. A moving camera's pose is then that of the frame's time on the robot's
    clock. Frames without a pose within `tolerance_ns` are left out and counted.
    """

    def __init__(self, source: FrameSource, change: "Correction | Perturbation", tolerance_ns: int) -> None:
        self.inner, self._change, self._tolerance_ns = source, change, tolerance_ns
        self.name, self.cameras, self.joint_names = source.name, source.cameras, source.joint_names
        self.has_clock, self.world_frame, self.tf_frames = source.has_clock, source.world_frame, source.tf_frames
        self.states, self.joint_topics = source.states, source.joint_topics
        if isinstance(change, Correction) and change.clock_ns:
            self.states, self.joint_topics = change.states(source.states), None

    @property
    def loss(self) -> LossReport:
        loss = self.inner.loss
        return replace(
            loss,
            without_pose=loss.without_pose + self._num_without_pose,
            notes=[*loss.notes, *self._change.notes(self.inner.digests().values())],
        )

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        for stamp, camera, T_recorded in self.inner.poses():
            T = self._pose(stamp, camera, T_recorded)
            if T is not None:
                yield stamp, camera, T

    def digests(self) -> dict[str, str]:
        return self.inner.digests() | self._change.digests()

    def _frames(self) -> Iterator[StoredFrame]:
        for item in self.inner.stored():
            if isinstance(item, StoredFrame):
                T = self._pose(item.stamp_ns, item.camera, item.T_world_camera)
                if T is not None:
                    yield self._change.changed(item, T)

    def _pose(self, stamp_ns: int, camera: str, T_recorded: Float64) -> Float64 | None:
        late_ns = self._change.late_ns(camera) if isinstance(self._change, Correction) else 0
        T: Float64 | None = T_recorded
        if late_ns and isinstance(self.inner, RosLogSource):
            T = self.inner.pose_at(camera, stamp_ns - late_ns)
        elif late_ns:
            T = _between(*self._paths[camera], stamp_ns - late_ns, self._tolerance_ns)
        return None if T is None else self._change.pose(camera, T)

    @cached_property
    def _num_without_pose(self) -> int:
        return sum(self._pose(*frame) is None for frame in self.inner.poses())

    @cached_property
    def _paths(self) -> dict[str, tuple[list[int], list[Float64]]]:
        posed = list(self.inner.poses())
        return {
            name: ([stamp for stamp, camera, _ in posed if camera == name], [T for _, c, T in posed if c == name])
            for name in self.cameras
        }


def _between(stamps: list[int], poses: list[Float64], stamp_ns: int, tolerance_ns: int) -> Float64 | None:
    after = int(np.searchsorted(stamps, stamp_ns))
    if after in (0, len(stamps)):
        end = min(after, len(stamps) - 1)
        return poses[end] if abs(stamp_ns - stamps[end]) <= tolerance_ns else None
    share = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
    return interpolate_transform(poses[after - 1], poses[after], share)


def _same(T_a: Float64, T_b: Float64) -> bool:
    distance, degrees = compare_poses(T_a, T_b)
    return distance < fixed.SAME_POSE_METRES and degrees < fixed.SAME_POSE_DEGREES


LIMITS = {"depth-noise": 1.0, "pose-error": 10.0, "pose-turn": 180.0, "seed": 2**31 - 1}  # m at 1 m, m, degrees


@dataclass(frozen=True, kw_only=True)
class Perturbation:
    """Errors drawn from `seed`, scaled by their sizes.

    depth_noise: standard deviation [m] at 1 m, which grows with depth squared. pose_error [m], pose_turn [degrees]:
    size of each camera's shift and turn.
    """

    depth_noise: float = 0.0
    pose_error: float = 0.0
    pose_turn: float = 0.0
    seed: int = 0

    @classmethod
    def of(cls, values: Mapping[str, float]) -> "Perturbation | None":
        """Build from sizes by name, or None if all are 0. Raises UsageError if invalid."""
        for name, value in values.items():
            refuse_if(
                name not in LIMITS,
                f"--perturb {name}: expected one of {', '.join(LIMITS)}",
                remedy="leave it out",
                error=UsageError,
            )
            refuse_if(
                not 0 <= value <= LIMITS[name] or (name == "seed" and value != int(value)),
                f"--perturb {name}: expected 0 to {LIMITS[name]:g}, got {value:g}",
                error=UsageError,
            )
        perturbation = cls(**{name.replace("-", "_"): int(v) if name == "seed" else v for name, v in values.items()})  # type: ignore[arg-type]
        return perturbation if perturbation.depth_noise or perturbation.pose_error or perturbation.pose_turn else None

    def depth(self, camera: str, stamp_ns: int, depth: Float32) -> Float32:
        """Add noise to depth (H, W) [m]; no return stays 0, negative depth becomes 0."""
        noise = self._generator(camera, stamp_ns).standard_normal(depth.shape, np.float32)
        noisy = depth + np.float32(self.depth_noise) * depth**2 * noise
        return np.where((depth > 0) & (noisy > 0), noisy, np.float32(0.0)).astype(np.float32)

    def pose(self, camera: str, T_world_camera: Float64) -> Float64:
        """Displace and turn T_world_camera (4, 4)."""
        way, axis = self._generator(camera).standard_normal((2, 3))
        half = np.radians(self.pose_turn) / 2
        quat_xyzw = [*(np.sin(half) * axis / np.linalg.norm(axis)), np.cos(half)]
        return np.asarray(T_world_camera @ transform_from(self.pose_error * way / np.linalg.norm(way), quat_xyzw))

    def changed(self, stored: StoredFrame, T: Float64) -> StoredFrame:
        if not self.depth_noise:
            return replace(stored, T_world_camera=T)
        return _replace_depth(stored, T, lambda: self.depth(stored.camera, stored.stamp_ns, stored.depth))

    def digests(self) -> dict[str, str]:
        """Values as on the command line, in place of a file's digest."""
        values = {"depth-noise": self.depth_noise, "pose-error": self.pose_error, "pose-turn": self.pose_turn}
        words = ",".join(f"{name}={value!r}" for name, value in {**values, "seed": self.seed}.items() if value)
        return {f"{PERTURB}{words}": words}

    def notes(self, _digests: Collection[str]) -> list[str]:
        return [f"perturbed: {words}" for words in self.digests().values()]

    def _generator(self, camera: str, stamp_ns: int = 0) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(camera.encode()), stamp_ns % 2**63])


LOGGED = RosLogSource | CaptureSource | ChangedSource  # a log's or a capture's records
