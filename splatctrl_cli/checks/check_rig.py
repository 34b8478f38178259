"""The cameras of a log: whether colour and depth pair, lenses fit, poses are there; a few reduced frames of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.checks.check_cameras import MAX_POSES, lens_findings, pose_findings
from splatctrl_cli.checks.check_images import ImageWatch, Kept, strided_lens
from splatctrl_cli.checks.finding import Finding, error, note, warning
from splatctrl_cli.containers.raw_log import RawLog
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.image_stamps import pair_by_stamp
from splatctrl_cli.logs.options import CameraTopics, SourceOptions
from splatctrl_cli.logs.registration import DepthToColor
from splatctrl_cli.logs.rig import Camera, build_cameras, intrinsics_of, nearest_gap_ns
from splatctrl_cli.logs.survey import Survey
from splatctrl_cli.logs.tf_tree import TfTree
from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame

MIN_PAIRED = 0.95  # of the images of the rarer topic
LATE_PAIR = 0.010  # [s] between colour and depth at which an arm at 1 m/s is 1 cm apart
MAX_PAIRED = 20_000  # stamps of a topic that are paired
FEWEST = 5  # images that a rate is judged by
SLOWER = 1.5  # of the images of one topic that the other has at least, for a note


@dataclass(frozen=True, kw_only=True)
class CheckedCamera:
    """A camera that is ready to be read, and reduced frames of it, spread over the log; color is black where none was
    kept at the time of the depth.
    """

    topics: CameraTopics
    camera: Camera
    frames: tuple[RgbdFrame, ...]


def ready(log: RawLog, found: Survey, topics: CameraTopics, options: SourceOptions) -> Camera | None:
    """The camera as `ingest` makes it ready; None where it lacks something (rig.missing says what)."""
    try:
        return build_cameras(log, found, replace(options, cameras=(topics.name,)))[0]
    except InputError:
        return None


def checked_camera(
    topics: CameraTopics, camera: Camera, images: Mapping[str, ImageWatch], tf: TfTree, options: SourceOptions
) -> CheckedCamera:
    """With the frames whose depth was kept and whose pose is known."""
    depths, colors = images.get(topics.depth), images.get(topics.color)
    kept_colors = {kept.stamp_ns: kept for kept in (colors.kept if colors is not None else ())}
    frames = []
    for kept in depths.kept if depths is not None else ():
        near = nearest(sorted(kept_colors), kept.stamp_ns)
        is_near = near is not None and abs(near - kept.stamp_ns) <= options.pairing_tolerance_s * 1e9
        color = kept_colors[near] if near is not None and is_near else None
        stamp_ns = kept.stamp_ns if color is None else color.stamp_ns
        T = camera.pose_at(tf, stamp_ns, round(options.pose_tolerance_s * 1e9))
        if T is not None:
            frames.append(_frame(camera, kept, color, stamp_ns, T))
    return CheckedCamera(topics=topics, camera=camera, frames=tuple(frames))


def _frame(camera: Camera, kept: Kept, color: Kept | None, stamp_ns: int, T: Float64) -> RgbdFrame:
    """Depth in the colour camera's view, without lens distortion, as `ingest` gives it but reduced."""
    assert kept.depth is not None
    depth: NDArray[Any] = kept.depth
    stride = kept.stride
    if camera.depth_to_color is not None:
        stride = max(1, round(camera.intrinsics.height / kept.depth.shape[0]))
        warp = camera.depth_to_color
        depth = DepthToColor(
            depth_intrinsics=strided_lens(warp.depth_intrinsics, kept.stride),
            color_intrinsics=strided_lens(camera.intrinsics, stride),
            T_color_depth=warp.T_color_depth,
        ).warp(depth)
    elif camera.undistortion is not None:
        depth = _reduced(camera.undistortion.depth(_enlarged(depth, kept)), stride)
    pixels: NDArray[Any] = np.zeros((*depth.shape, 3), np.uint8)
    if color is not None and color.color is not None:
        pixels = color.color
        if camera.undistortion is not None:
            pixels = _reduced(camera.undistortion.color(_enlarged(pixels, color)), color.stride)
    if pixels.shape[:2] != depth.shape:
        pixels = np.zeros((*depth.shape, 3), np.uint8)
    return RgbdFrame(
        stamp_ns=stamp_ns,
        camera=camera.name,
        color=pixels,
        depth=np.asarray(depth, np.float32),
        intrinsics=strided_lens(camera.intrinsics, stride),
        T_world_camera=T,
    )


def _enlarged(image: NDArray[Any], kept: Kept) -> NDArray[Any]:
    rows = np.repeat(image, kept.stride, axis=0)[: kept.height]
    return np.repeat(rows, kept.stride, axis=1)[:, : kept.width]


def _reduced(image: NDArray[Any], stride: int) -> NDArray[Any]:
    return image[::stride, ::stride]


def nearest(stamps: Sequence[int], stamp_ns: int) -> int | None:
    """Of stamps in order."""
    if not stamps:
        return None
    after = int(np.searchsorted(np.array(stamps), stamp_ns))
    return min(stamps[max(0, after - 1) : after + 1], key=lambda stamp: abs(stamp - stamp_ns))


def camera_findings(
    found: Survey, topics: CameraTopics, camera: Camera | None, options: SourceOptions
) -> list[Finding]:
    """Pairs, lens and poses of one camera."""
    findings = [*_pairing(found, topics, options), *_lens(found, topics, options)]
    if camera is None or camera.fixed_pose is not None:
        return findings
    stamps = sorted(found.topics[topics.color].stamps_ns)[:MAX_POSES]
    tolerance_ns = round(options.pose_tolerance_s * 1e9)
    poses = [camera.pose_at(found.tf, stamp, tolerance_ns) for stamp in stamps]
    return [*findings, *pose_findings(f"camera {topics.name}", stamps, poses)]


def _pairing(found: Survey, camera: CameraTopics, options: SourceOptions) -> list[Finding]:
    where = f"camera {camera.name}"
    color, depth = (found.topics[t].stamps_ns[:MAX_PAIRED] for t in (camera.color, camera.depth))
    pairs = pair_by_stamp(color, depth, round(options.pairing_tolerance_s * 1e9))
    rarer, other = sorted((len(color), len(depth)))
    if not pairs or not rarer:
        gap = nearest_gap_ns(color, depth) * 1e-9
        text = f"no colour image has a depth image of its time; the closest are {1e3 * gap:.4g} ms apart"
        remedy = f"give --pairing-tolerance {gap * 1.01 + 1e-4:.3g} (seconds), if that is right"
        return [error("pairing", where, text, remedy, value=1e3 * gap, unit="ms")]
    findings = []
    if len(pairs) < MIN_PAIRED * rarer:
        text = f"{len(pairs)} of {rarer} images find a partner within {1e3 * options.pairing_tolerance_s:g} ms"
        remedy = "let the driver synchronise colour and depth, or give --pairing-tolerance"
        findings.append(warning("pairing", where, text, remedy, value=len(pairs) / rarer))
    if other > SLOWER * rarer and rarer >= FEWEST and max(len(color), len(depth)) < MAX_PAIRED:
        names = ("depth", "colour") if len(depth) < len(color) else ("colour", "depth")
        text = f"{rarer} {names[0]} images to {other} of {names[1]}: {other - len(pairs)} {names[1]} images go unused"
        remedy = "record both at one rate; more frames show more, and what moves is seen sooner"
        findings.append(note("rates-differ", where, text, remedy, value=rarer / other))
    offset = float(np.median([depth[j] - color[i] for i, j in pairs])) * 1e-9
    if abs(offset) > LATE_PAIR:
        text = f"depth is stamped {1e3 * offset:+.1f} ms against its colour image (median)"
        remedy = "let the driver synchronise colour and depth: what moves is in two places"
        findings.append(note("pair-offset", where, text, remedy, value=1e3 * offset, unit="ms"))
    return findings


def _lens(found: Survey, topics: CameraTopics, options: SourceOptions) -> list[Finding]:
    """Of the lens that is used: the one given, else the CameraInfo's; and of depth's own."""
    where, image = f"camera {topics.name}", found.topics[topics.color].first_image
    given = options.intrinsics.get(topics.name)
    if given is not None and image is not None:
        fx, fy, cx, cy = given
        lens = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=image.width, height=image.height)
        return lens_findings(where, lens, "--intrinsics")
    found_by: list[Finding] = []
    for name in dict.fromkeys(name for name in (topics.info, topics.depth_info) if name):
        calibration = found.topics[name].calibration
        if calibration is not None and calibration.width:
            found_by += lens_findings(where, intrinsics_of(calibration), name)
    return found_by
