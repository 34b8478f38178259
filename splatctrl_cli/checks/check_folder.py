"""Everything that is wrong with a capture or an image folder, from one pass over its frames."""

from pathlib import Path

import numpy as np

from splatctrl_cli.captures.capture_header import is_capture
from splatctrl_cli.checks.check_cameras import lens_findings, pose_findings
from splatctrl_cli.checks.check_images import ImageWatch, depth_findings, sample_findings
from splatctrl_cli.checks.check_states import RobotStates, robot_states
from splatctrl_cli.checks.check_times import TimesWatch, time_findings
from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.checks.finding import CheckReport, Finding, damage_findings, error, needs, note, warning
from splatctrl_cli.checks.judge_evidence import Evidence, judged
from splatctrl_cli.datasets.image_folder import ImageFolderSource
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import strided_lens
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.logs.state_columns import StateCollector
from splatctrl_cli.logs.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.records import Float64, Intrinsics, JointState, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.sources.source import open_source

_LOST = {
    "unpaired_color": "colour images without a depth image of their time",
    "unpaired_depth": "depth images without a colour image of their time",
    "without_pose": "images without a pose",
    "without_intrinsics": "images without intrinsics",
}


class _CameraWatch:
    """What is kept of one camera's frames."""

    def __init__(self, lens: Intrinsics, where: str, unit: float | None) -> None:
        self.lens = lens
        self.images, self.colors = ImageWatch(where, unit), ImageWatch(where)
        self.times = TimesWatch(where, has_stamps=False)
        self.stamps: list[int] = []
        self.poses: list[Float64] = []

    def add(self, stored: StoredFrame, motion: ImageMotion) -> None:
        """Take a frame; its images are decoded where they are wanted."""
        self.times.add(stored.stamp_ns, stored.stamp_ns)
        self.stamps.append(stored.stamp_ns)
        self.poses.append(stored.T_world_camera)
        encoding = "32FC1" if stored.depth_unit is None else "16UC1"
        if self.images.is_wanted():
            self.images.add_depth(stored.stamp_ns, stored.depth, encoding)
            self.colors.add_color(stored.stamp_ns, stored.color, "rgb8")
            motion.add(stored.frame)
        else:
            self.images.add_undecoded(encoding, self.lens.width, self.lens.height)

    def frames(self, camera: str) -> list[RgbdFrame]:
        """The kept images with their poses; by number, for views of a folder may have no clock."""
        poses = dict(zip(self.stamps, self.poses, strict=True))
        return [
            RgbdFrame(
                stamp_ns=depth.stamp_ns,
                camera=camera,
                color=color.color if color.color is not None else np.zeros((*depth.depth.shape, 3), np.uint8),
                depth=depth.depth,
                intrinsics=strided_lens(self.lens, depth.stride),
                T_world_camera=poses[depth.stamp_ns],
            )
            for depth, color in zip(self.images.kept, self.colors.kept, strict=True)
            if depth.depth is not None
        ]


class _SourceWatch:
    """What is kept of a source's frames and joint states."""

    def __init__(self, num_joints: int) -> None:
        self.cameras: dict[str, _CameraWatch] = {}
        self.states = StateCollector(num_joints)
        self.motion = ImageMotion()
        self.is_whole = True

    def read(self, source: FrameSource, num_images: int | None) -> None:
        """Take all; with `num_images` up to as many of a camera."""
        for item in source.stored():
            if isinstance(item, JointState):
                self.states.add(item)
                continue
            if item.camera not in self.cameras:
                self.cameras[item.camera] = _CameraWatch(item.intrinsics, f"camera {item.camera}", item.depth_unit)
            self.cameras[item.camera].add(item, self.motion)
            if len(self.cameras[item.camera].stamps) == num_images:
                self.is_whole = False
                return


def check_folder(
    path: Path, options: SourceOptions, *, model: RobotModel | None = None, num_images: int | None = None
) -> CheckReport:
    """Read the frames of `path` once; with `num_images` up to as many of a camera."""
    kind = "capture" if is_capture(path) else "image folder"
    try:
        source = open_source(path, options)
    except InputError as wrong:
        return _refused(path, kind if path.is_file() or is_capture(path) else "folder", wrong)
    watch = _SourceWatch(len(source.joint_names))
    findings: list[Finding] = []
    try:
        watch.read(source, num_images)
    except InputError as wrong:
        findings.append(error("refused", path.name, wrong.message, wrong.remedy))
    findings += _losses(source, path.name)
    cameras = dict(sorted(watch.cameras.items()))
    if not cameras and not any(finding.code == "refused" for finding in findings):
        findings.append(error("missing", path.name, "no frame could be read", "copy or record it again"))
    for camera in cameras.values():
        findings += _camera_findings(camera, has_clock=source.has_clock)
    findings += sample_findings([camera.images for camera in cameras.values()])
    logged = watch.states.columns()
    lack = "" if len(logged) else "no joint states; give them apart (docs/replay.md, Logs)"
    of_states = RobotStates(model=model, lack=lack)
    if len(logged) and source.has_clock:
        of_states = robot_states(model, source.joint_names, logged)
        findings += of_states.findings
    stamps = [stamp for camera in cameras.values() for stamp in camera.stamps]
    evidence = Evidence(
        path=path,
        kind=kind,
        duration_s=(max(stamps) - min(stamps)) * 1e-9 if stamps and source.has_clock else 0.0,
        num_messages=len(stamps) + len(logged),
        start_ns=min(stamps, default=None) if source.has_clock else None,
        num_cameras=len(cameras),
        num_frames=max((len(camera.stamps) for camera in cameras.values()), default=0),
        rates=[camera.times.rate(is_read=True) for camera in cameras.values()] if source.has_clock else [],
        frames=[frame for name, camera in cameras.items() for frame in camera.frames(name)],
        depth_units={name: camera.images.scale for name, camera in cameras.items()},
        motion=watch.motion,
        states=of_states.states,
        states_lack=of_states.lack,
        is_guessed=isinstance(source, ImageFolderSource) and source.guess != "",
        cut="" if watch.is_whole else f"only the first {num_images} frames of a camera were read",
    )
    return judged(evidence, findings, of_states.model)


def _refused(path: Path, kind: str, wrong: InputError) -> CheckReport:
    return CheckReport(
        path=str(path),
        kind=kind,
        duration_s=0.0,
        num_messages=0,
        start_ns=None,
        findings=[error("refused", path.name, wrong.message.removeprefix(f"{path}: "), wrong.remedy)],
        needs=needs(num_cameras=0, num_frames=0, states_lack=""),
    )


def _losses(source: FrameSource, where: str) -> list[Finding]:
    loss = source.loss
    findings = damage_findings(where, loss.notes[:50])
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


def _camera_findings(camera: _CameraWatch, *, has_clock: bool) -> list[Finding]:
    where = camera.images.where
    findings = [*lens_findings(where, camera.lens), *depth_findings(camera.images)]
    if has_clock:
        findings += time_findings(camera.times, "frames")
        findings += pose_findings(where, camera.stamps, camera.poses)
    return findings
