"""Checks of a capture or image folder in one pass, judged as logs are."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.calibration.gray_views import BandRatios, band_ratios
from splatctrl_cli.checks import limits
from splatctrl_cli.checks.check_arm import motion_findings
from splatctrl_cli.checks.check_cameras import lens_findings, pose_findings
from splatctrl_cli.checks.check_images import ImageWatch, alignment_findings, depth_findings, sample_findings
from splatctrl_cli.checks.check_states import RobotStates, robot_states
from splatctrl_cli.checks.check_times import TimesWatch, time_findings
from splatctrl_cli.checks.check_views import are_far, check_views
from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.checks.finding import (
    ERROR,
    NOTE,
    WARNING,
    CheckReport,
    Finding,
    damage_findings,
    error,
    find_lacks,
    judge,
    note,
)
from splatctrl_cli.config.fixed import SCALE_DEPTH
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import strided_lens
from splatctrl_cli.recording.capture.capture import is_capture
from splatctrl_cli.recording.folder.image_folder import ImageFolderSource
from splatctrl_cli.recording.log.state_columns import StateCollector, StateColumns
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, Intrinsics, JointState, RgbdFrame, spread
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.scale import RecordedDepth


def judge_frames(
    report: CheckReport,
    model: RobotModel | None,
    *,
    frames: Sequence[RgbdFrame],
    depth_units: Mapping[str, float | None],
    motion: ImageMotion,
    states: StateColumns | None,
    cut: str = "",
    is_guessed: bool = False,
    only_errors: bool = False,
) -> CheckReport:
    """Add findings on frames, alone and compared with states, to a report.

    frames: reduced, a few per camera with known poses. depth_units: [m] per count by camera, None for floats. motion:
    in the first images. states: in the model's order. cut: why not all was read. is_guessed: True if the unit of
    lengths is. only_errors: skip checks that find only notes and warnings.
    """
    findings = [*report.findings, *alignment_findings(frames)]
    usable, is_still = usable_frames(frames, findings), report.start_ns is None
    wrong, scaled, corrected = check_views(
        usable, depth_units, is_sure=not is_still or not (is_guessed or are_far(usable)), only_errors=only_errors
    )
    findings += wrong if only_errors else [*wrong, *exposure_findings(corrected)]
    is_known = states is not None and not any(finding.code == "joints-degrees" for finding in findings)
    if states is not None and is_known and not only_errors:
        findings += motion_findings(corrected, motion, states, model, depth_units.values())
    findings += [note("quick", Path(report.path).name, cut)] if cut else []
    return replace(report, findings=findings, frames=scaled)


def usable_frames(frames: Sequence[RgbdFrame], findings: Sequence[Finding]) -> list[RgbdFrame]:
    """Frames of cameras with correct lens and depth."""
    wrong = {f.where for f in findings if f.severity is ERROR and f.code in {"alignment", "principal-point"}}
    return [frame for frame in frames if f"camera {frame.camera}" not in wrong]


def exposure_findings(frames: Sequence[RgbdFrame]) -> Iterator[Finding]:
    """Brightness ratios per camera: between images of a surface, and between rows of an image."""
    cameras = sorted({frame.camera for frame in frames})
    whole = [frame for frame in frames if frame.depth.shape == frame.color.shape[:2]]
    chosen = [f for c in cameras for f in spread([f for f in whole if f.camera == c], limits.EXPOSURE_FRAMES)]
    depth = RecordedDepth.of(chosen)
    if depth is None:
        return
    scale = depth.median / SCALE_DEPTH
    is_free = np.ones(len(chosen), np.bool_)
    gains = band_ratios(chosen, scale, is_free, 1).gains(is_free)
    rows = _rows(band_ratios(chosen, scale, is_free, limits.EXPOSURE_BANDS), gains)
    for camera in cameras:
        is_own, where = [frame.camera == camera for frame in chosen], f"camera {camera}"
        own = gains[is_own, 0]
        ratio = float((own.max(axis=0) / own.min(axis=0)).max()) - 1
        yield from judge(
            NOTE if ratio > limits.EXPOSURE_RATIO else None,
            "exposure",
            where,
            f"one image shows a surface up to {100 * ratio:.0f} % brighter or more coloured than another",
            "fix exposure and white balance in its driver; 'reconstruct' corrects the views of a still scene",
            value=round(100 * ratio, 1),
            unit="%",
        )
        uneven = float(np.exp(np.ptp(rows[is_own] - np.median(rows[is_own], axis=0), axis=1).max())) - 1
        yield from judge(
            NOTE if uneven > limits.EXPOSURE_UNEVEN else None,
            "exposure-rows",
            where,
            f"rows of one image differ in exposure by up to {100 * uneven:.0f} %, unlike those of its others",
            "set the driver's anti-flicker to the mains frequency, or expose for whole periods of the lamp;"
            " 'reconstruct' has one gain for a whole image and leaves this as it is",
            value=round(100 * uneven, 1),
            unit="%",
        )


def _rows(bands: BandRatios, gains: Float64) -> Float64:
    """Log brightness (N, B) by bands of rows, minus a parabola for slowly varying gloss."""
    gains_by_band = bands.gains(np.ones(bands.num_images, np.bool_))
    logs = np.log(gains_by_band).mean(axis=2)
    if bands.misfit(gains_by_band) > limits.EXPOSURE_LEFT * bands.misfit(gains):
        return np.zeros_like(logs)
    curves = np.linalg.qr(np.vander(np.arange(bands.num_bands), 3).astype(np.float64))[0]
    return np.asarray(logs - logs @ curves @ curves.T)


_LOST = {  # the finding, and what was lost, by the field of a loss
    "unpaired_color": ("pairing", "colour images without a depth image of their time"),
    "unpaired_depth": ("pairing", "depth images without a colour image of their time"),
    "without_pose": ("pose-missing", "images without a pose"),
    "without_intrinsics": ("pairing", "images without intrinsics"),
}


class _CameraWatch:
    def __init__(self, lens: Intrinsics, where: str, unit: float | None) -> None:
        self.lens = lens
        self.images, self.colors = ImageWatch(where, unit), ImageWatch(where)
        self.times = TimesWatch(where, has_stamps=False)
        self.stamps: list[int] = []
        self.poses: list[Float64] = []

    def add(self, stored: StoredFrame, motion: ImageMotion) -> None:
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
        """Kept depth images with poses; colour pairs by number, because folders may lack clocks."""
        poses = dict(zip(self.stamps, self.poses, strict=True))
        return [
            RgbdFrame(
                stamp_ns=depth.stamp_ns,
                camera=camera,
                color=color.pixels,
                depth=depth.pixels,
                intrinsics=strided_lens(self.lens, depth.stride),
                T_world_camera=poses[depth.stamp_ns],
            )
            for depth, color in zip(self.images.samples, self.colors.samples, strict=True)
        ]


def _read(
    source: FrameSource,
    cameras: dict[str, _CameraWatch],
    states: StateCollector,
    motion: ImageMotion,
    num_images: int | None,
) -> bool:
    for item in source.stored():
        if isinstance(item, JointState):
            states.add(item)
            continue
        if item.camera not in cameras:
            cameras[item.camera] = _CameraWatch(item.intrinsics, f"camera {item.camera}", item.depth_unit)
        cameras[item.camera].add(item, motion)
        if len(cameras[item.camera].stamps) == num_images:
            return False
    return True


def check_folder(
    path: Path,
    options: SourceOptions,
    *,
    model: RobotModel | None = None,
    num_images: int | None = None,
    only_errors: bool = False,
) -> CheckReport:
    """Check `path` in one pass; at most `num_images` frames per camera."""
    kind = "capture" if is_capture(path) else "image folder"
    try:
        source = open_source(path, options)
    except InputError as wrong:
        return CheckReport(
            path=str(path),
            kind=kind if path.is_file() or is_capture(path) else "folder",
            duration_s=0.0,
            num_messages=0,
            start_ns=None,
            findings=[error("refused", path.name, wrong.message.removeprefix(f"{path}: "), wrong.remedy)],
            lacks=find_lacks(num_cameras=0, num_frames=0, states_lack=""),
        )
    cameras: dict[str, _CameraWatch] = {}
    states, motion, is_whole = StateCollector(len(source.joint_names)), ImageMotion(), True
    findings: list[Finding] = []
    try:
        is_whole = _read(source, cameras, states, motion, num_images)
    except InputError as wrong:
        findings.append(error("refused", path.name, wrong.message, wrong.remedy))
    findings += _losses(source, path.name)
    cameras, logged = dict(sorted(cameras.items())), states.columns()
    if not cameras and not any(finding.code == "refused" for finding in findings):
        findings.append(error("missing", path.name, "no frame could be read", "copy or record it again"))
    for camera in cameras.values():
        findings += _camera_findings(camera, has_clock=source.has_clock)
    findings += sample_findings([camera.images for camera in cameras.values()])
    of_states = _states(source, logged, model)
    most = max((len(camera.stamps) for camera in cameras.values()), default=0)
    stamps = [stamp for camera in cameras.values() for stamp in camera.stamps]
    return judge_frames(
        CheckReport(
            path=str(path),
            kind=kind,
            duration_s=(max(stamps) - min(stamps)) * 1e-9 if stamps and source.has_clock else 0.0,
            num_messages=len(stamps) + len(logged),
            start_ns=min(stamps, default=None) if source.has_clock else None,
            findings=[*findings, *of_states.findings],
            rates=[camera.times.rate(is_read=True) for camera in cameras.values()] if source.has_clock else [],
            lacks=find_lacks(num_cameras=len(cameras), num_frames=most, states_lack=of_states.lack),
        ),
        of_states.model,
        frames=[frame for name, camera in cameras.items() for frame in camera.frames(name)],
        depth_units={name: camera.images.scale for name, camera in cameras.items()},
        motion=motion,
        states=of_states.states,
        is_guessed=isinstance(source, ImageFolderSource) and source.guess != "",
        cut="" if is_whole else f"only the first {num_images} frames of a camera were read",
        only_errors=only_errors,
    )


def _states(source: FrameSource, logged: StateColumns, model: RobotModel | None) -> RobotStates:
    if len(logged) and source.has_clock:
        return robot_states(model, source.joint_names, logged, source.tf_frames)
    lack = "" if len(logged) else "no joint states; give them apart (splatctrl help replay, Logs)"
    return RobotStates(model=model, lack=lack)


def _losses(source: FrameSource, where: str) -> Iterator[Finding]:
    loss = source.loss
    notes = loss.notes[:50]
    yield from damage_findings(where, notes) if loss.damaged else (note("loss", where, text) for text in notes)
    for name, (code, words) in _LOST.items():
        count = getattr(loss, name)
        yield from judge(
            WARNING if count else None, code, where, f"{count} {words}", "they are left out", value=count
        )
    num, text = loss.invalid_depth, "depth pixels are NaN, infinite, negative or 65535: they count as none"
    yield from judge(NOTE if num else None, "depth-invalid", where, f"{num} {text}", value=num)


def _camera_findings(camera: _CameraWatch, *, has_clock: bool) -> Iterator[Finding]:
    where = camera.images.where
    yield from lens_findings(where, camera.lens)
    yield from depth_findings(camera.images)
    if has_clock:
        yield from time_findings(camera.times, "frames")
        yield from pose_findings(where, camera.stamps, camera.poses)
