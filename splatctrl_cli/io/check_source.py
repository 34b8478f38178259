"""Everything that is wrong with a capture or an image folder, from one pass over its frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.capture import is_capture
from splatctrl_cli.io.check_arm import arm_agreement, arm_findings
from splatctrl_cli.io.check_cameras import lens_findings, pose_findings
from splatctrl_cli.io.check_images import ImageWatch, KeptDepth, depth_findings, strided_lens
from splatctrl_cli.io.check_report import CheckReport, needs
from splatctrl_cli.io.check_states import robot_findings
from splatctrl_cli.io.check_times import TimesWatch, time_findings
from splatctrl_cli.io.finding import Finding, error, note, warning
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.shot import Shot, ShotSource
from splatctrl_cli.io.source import open_source
from splatctrl_cli.io.state_motion import ImageMotion
from splatctrl_cli.io.state_offset import RobotPoints, estimate_clock_offset
from splatctrl_cli.records import Float64, Intrinsics, JointState, RgbdFrame
from splatctrl_cli.robot.model import RobotModel

_LOST = {
    "unpaired_color": "colour images without a depth image of their time",
    "unpaired_depth": "depth images without a colour image of their time",
    "without_pose": "images without a pose",
    "without_intrinsics": "images without intrinsics",
}


class _CameraWatch:
    """What is kept of one camera's frames."""

    def __init__(self, lens: Intrinsics, where: str, scale: float | None) -> None:
        self.lens, self.images, self.times = lens, ImageWatch(where, scale), TimesWatch(where, has_stamps=False)
        self.stamps: list[int] = []
        self.poses: list[Float64] = []

    def add(self, frame: RgbdFrame, unit: float | None) -> None:
        self.times.add(frame.stamp_ns, frame.stamp_ns)
        self.stamps.append(frame.stamp_ns)
        self.poses.append(frame.T_world_camera)
        encoding = "32FC1" if unit is None else "16UC1"
        self.images.scale = unit if unit is not None else self.images.scale
        self.images.add_depth(frame.stamp_ns, frame.depth, encoding)

    def posed(self) -> list[tuple[KeptDepth, Float64]]:
        """The kept depth images with their poses."""
        by_stamp = dict(zip(self.stamps, self.poses, strict=True))
        return [(kept, by_stamp[kept.stamp_ns]) for kept in self.images.kept]


def check_source(
    path: Path, options: SourceOptions, *, model: RobotModel | None = None, num_images: int | None = None
) -> CheckReport:
    """Read the frames of `path` once; with `num_images` up to as many of a camera."""
    kind = "capture" if is_capture(path) else "image folder"
    try:
        source = open_source(path, options)
    except InputError as wrong:
        return _refused(path, kind, wrong)
    cameras: dict[str, _CameraWatch] = {}
    states: list[JointState] = []
    motion = ImageMotion()
    findings: list[Finding] = []
    is_whole = True
    try:
        for item in source.shots():
            if isinstance(item, JointState):
                states.append(item)
                continue
            is_whole = _take(item, cameras, motion, num_images)
            if not is_whole:
                break
    except InputError as wrong:
        findings.append(error("refused", path.name, wrong.message, wrong.remedy))
    findings += _losses(source, path.name)
    for name, camera in sorted(cameras.items()):
        findings += _camera_findings(f"camera {name}", camera, has_clock=source.has_clock)
    findings += _robot(source, cameras, states, motion, model)
    if not is_whole:
        findings.append(note("quick", path.name, f"only the first {num_images} frames of a camera were read"))
    return _report(path, kind, source, cameras, states, findings)


def _take(shot: Shot, cameras: dict[str, _CameraWatch], motion: ImageMotion, num_images: int | None) -> bool:
    """Watch a frame; False where it was the last that is wanted."""
    frame = shot.frame
    where = f"camera {frame.camera}"
    camera = cameras.setdefault(frame.camera, _CameraWatch(frame.intrinsics, where, shot.depth_unit))
    camera.add(frame, shot.depth_unit)
    motion.add(frame)
    return len(camera.stamps) != num_images


def _refused(path: Path, kind: str, wrong: InputError) -> CheckReport:
    return CheckReport(
        path=str(path),
        kind=kind,
        duration_s=0.0,
        num_messages=0,
        start_ns=None,
        findings=[error("refused", path.name, wrong.message, wrong.remedy)],
        needs=needs(lacks=[str(wrong)], num_cameras=0, num_frames=0, has_joints=False, states_lack="no joint states"),
    )


def _losses(source: ShotSource, where: str) -> list[Finding]:
    loss = source.loss
    findings = [warning("damaged", where, text, "copy it again, or run ingest again") for text in loss.notes[:50]]
    if not loss.damaged:
        findings = [note("loss", where, text) for text in loss.notes[:50]]
    for name, words in _LOST.items():
        count = getattr(loss, name)
        if count:
            code = "pose-missing" if name == "without_pose" else "pairing"
            findings.append(warning(code, where, f"{count} {words}", "they are left out", value=count))
    if loss.invalid_depth:
        text = f"{loss.invalid_depth} depth pixels are NaN, infinite or negative: they count as none"
        findings.append(note("depth-invalid", where, text, value=loss.invalid_depth))
    return findings


def _camera_findings(where: str, camera: _CameraWatch, *, has_clock: bool) -> list[Finding]:
    findings = [*lens_findings(where, camera.lens), *depth_findings(camera.images)]
    if has_clock:
        findings += time_findings(camera.times, "frames")
        findings += pose_findings(where, camera.stamps, camera.poses)
    return findings


def _robot(
    source: ShotSource,
    cameras: dict[str, _CameraWatch],
    states: list[JointState],
    motion: ImageMotion,
    model: RobotModel | None,
) -> list[Finding]:
    if not states or not source.has_clock:
        return []
    robot, findings = None, []
    if model is not None and set(model.joint_names) <= set(source.joint_names):
        order = model.joint_order(source.joint_names)
        states = [replace(s, position=s.position[order], velocity=s.velocity[order]) for s in states]
        findings = robot_findings(model, states, "joint states")
        centers = np.array([model.sphere_centers(state.position) for state in states])
        robot = RobotPoints(centers=centers, radii=model.sphere_set.radii)
        stamps = np.array([state.stamp_ns for state in states], dtype=np.int64)
        for name, camera in sorted(cameras.items()):
            agreement = arm_agreement(model, camera.lens, camera.posed(), states, stamps)
            findings += [] if agreement is None else arm_findings(f"camera {name}", agreement)
    if motion.cameras:
        offset = estimate_clock_offset(states, motion, robot)
        findings.append(note("robot-clock", "joint states", offset.sentence))
    return findings


def _report(
    path: Path,
    kind: str,
    source: ShotSource,
    cameras: dict[str, _CameraWatch],
    states: list[JointState],
    findings: list[Finding],
) -> CheckReport:
    stamps = [stamp for camera in cameras.values() for stamp in camera.stamps]
    frames = [
        RgbdFrame(
            stamp_ns=kept.stamp_ns,
            camera=name,
            color=np.zeros((*kept.depth.shape, 3), np.uint8),
            depth=kept.depth,
            intrinsics=strided_lens(camera.lens, kept),
            T_world_camera=T,
        )
        for name, camera in sorted(cameras.items())
        for kept, T in camera.posed()
    ]
    return CheckReport(
        path=str(path),
        kind=kind,
        duration_s=(max(stamps) - min(stamps)) * 1e-9 if stamps and source.has_clock else 0.0,
        num_messages=len(stamps) + len(states),
        start_ns=min(stamps, default=None) if source.has_clock else None,
        findings=findings,
        rates=[camera.times.rate(is_read=True) for _, camera in sorted(cameras.items())] if source.has_clock else [],
        needs=needs(
            lacks=[] if stamps else ["no frame could be read; see the findings"],
            num_cameras=len(cameras),
            num_frames=max((len(camera.stamps) for camera in cameras.values()), default=0),
            has_joints=bool(states),
            states_lack="no joint states; give them apart (docs/replay.md, Logs)",
        ),
        frames=frames,
    )
