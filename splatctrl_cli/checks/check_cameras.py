"""Checks of cameras: colour-depth pairs, intrinsics, distortion and poses."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from splatctrl_cli.checks import limits
from splatctrl_cli.checks.finding import Finding, error, note, warning
from splatctrl_cli.config.fixed import TF_GAP_NS
from splatctrl_cli.recording.log.decoder import CAMERA_INFO
from splatctrl_cli.recording.log.registration import DISTORTION_MODELS, is_distorted, lens_model
from splatctrl_cli.recording.log.rig import Camera, ImageLens, image_lens, intrinsics_of, nearest_gap_ns
from splatctrl_cli.recording.log.survey import Calibration, Survey, TopicSurvey, paired
from splatctrl_cli.recording.source_options import NUM_COEFFICIENTS, CameraTopics, SourceOptions
from splatctrl_cli.records import Float64, Intrinsics

_DONE: Mapping[ImageLens, str] = {
    "distorted": "undistorts",
    "rectified": "takes P for the rectified",
    "contradicted": "refuses",
}
NUM_DISTORTION = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


def lens_findings(where: str, lens: Intrinsics, source: str = "") -> Iterator[Finding]:
    """Findings on intrinsics by image size; source: their origin."""
    says = f"{source}: " if source else ""
    remedy = "calibrate again, or give the CameraInfo of this very stream (a crop or another size has its own)"
    off = [(c + 0.5) / size - 0.5 for c, size in ((lens.cx, lens.width), (lens.cy, lens.height))]
    if max(map(abs, off)) > limits.LENS_CENTRE:
        worst = max(off, key=abs)
        text = f"{says}cx, cy = {lens.cx:.1f}, {lens.cy:.1f} px of {lens.width}x{lens.height}"
        text, make = f"{text}: {100 * abs(worst):.0f} % off the middle of the image", warning
        times = [2 * (share + 0.5) for share in off]
        if abs(times[0] / times[1] - 1) < limits.LENS_SAME_FACTOR:
            factor = float(np.mean(times))
            size = f"{factor * lens.width:.0f}x{factor * lens.height:.0f}"
            text, remedy = f"{text}, as if calibrated at about {size}", f"scale K by {1 / factor:.3g}, or {remedy}"
            make = error
        yield make("principal-point", where, text, remedy, value=round(100 * worst, 1), unit="%")
    ratio = lens.fx / lens.fy
    if abs(ratio - 1) > limits.LENS_RATIO:
        text = (
            f"{says}fx / fy = {ratio:.3f} ({lens.fx:.1f}, {lens.fy:.1f} px): pixels are square in every RGB-D camera"
        )
        yield warning("focal-ratio", where, text, remedy, value=ratio)
    angle = math.degrees(2 * math.atan(0.5 * lens.width / lens.fx))
    low, high = limits.LENS_FIELD_OF_VIEW
    if not low <= angle <= high:
        text = (
            f"{says}field of view {angle:.0f} deg (fx {lens.fx:.1f} of {lens.width} px): expected {low:g} to {high:g}"
        )
        yield warning("field-of-view", where, text, remedy, value=angle, unit="deg")


def calibration_findings(
    found: Survey, cameras: Sequence[CameraTopics], changed: dict[str, int]
) -> Iterator[Finding]:
    """Findings on CameraInfo; `changed`: stamps of first changes."""
    for entry in found.of_type(CAMERA_INFO):
        name, calibration = entry.topic.name, entry.calibration
        if calibration is None:
            make = note if cameras and all(camera.info for camera in cameras) else warning
            yield make("uncalibrated", name, "K is zero: the camera was never calibrated")
            continue
        if name in changed:
            yield warning(
                "camera-info-changes",
                name,
                "the CameraInfo changes within the log; the first is used for all frames",
                stamp_ns=changed[name],
            )
    for topic, info in dict.fromkeys((c.color, c.info) for c in cameras if c.info) | dict.fromkeys(
        (c.depth, c.depth_info) for c in cameras if c.depth_info
    ):
        its = found.topics[info].calibration
        finding = None if its is None else _distortion(info, its, topic, image_lens(found, topic, its))
        if finding is not None:
            yield finding
    for camera in cameras:
        yield from _sizes(found, camera)
        yield from _rivals(found, camera)


def _distortion(name: str, calibration: Calibration, topic: str, lens: ImageLens) -> Finding | None:
    """Say how `ingest` treats the distortion of a topic's images."""
    d, model = calibration.distortion, lens_model(calibration.distortion_model)
    if not is_distorted(model, d):
        return None
    if model not in DISTORTION_MODELS:
        return error(
            "distortion",
            name,
            f"distortion model {model!r} is unknown",
            f"rectify the images first; known: {', '.join(DISTORTION_MODELS)}",
        )
    if len(d) not in NUM_DISTORTION[model]:
        expected = " or ".join(map(str, NUM_DISTORTION[model]))
        is_read = len(d) in NUM_COEFFICIENTS if model != "equidistant" else len(d) > 4 and not np.any(d[4:])
        make = warning if is_read else error
        return make(
            "distortion",
            name,
            f"{model} with {len(d)} coefficients, expected {expected}",
            "calibrate again",
            value=len(d),
        )
    done = f"{model} ({', '.join(f'{v:.4g}' for v in d[:5])}): ingest {_DONE[lens]} {topic}"
    if lens == "distorted" and topic.endswith("rect_raw"):
        return warning(
            "distortion",
            name,
            f"{done}, whose name says rectified",
            "give --intrinsics NAME=FX,FY,CX,CY if the images are rectified",
        )
    if lens == "contradicted":
        return error(
            "distortion",
            name,
            f"{done}, whose name says rectified",
            "give --intrinsics NAME=FX,FY,CX,CY if the images are rectified, with D1,D2,... behind it if not",
        )
    return note("distortion", name, done)


def _sizes(found: Survey, camera: CameraTopics) -> Iterator[Finding]:
    for topic, info in ((camera.color, camera.info), (camera.depth, camera.depth_info or camera.info)):
        image = found.topics[topic].first_image
        calibration = found.topics[info].calibration if info else None
        if image is None or calibration is None or calibration.width == 0:
            continue
        if (image.width, image.height) != (calibration.width, calibration.height):
            yield error(
                "camera-info-size",
                info,
                f"{topic} is {image.width}x{image.height}, its CameraInfo {calibration.width}x{calibration.height}",
            )


def _rivals(found: Survey, camera: CameraTopics) -> list[Finding]:
    """Other CameraInfo with the colour image's frame and size, but another K."""
    chosen = found.topics[camera.info].calibration if camera.info else None
    if chosen is None:
        return []
    return [
        warning(
            "camera-info-two",
            f"camera {camera.name}",
            f"{rival.topic.name} has the frame and size of {camera.info}, but another K: the latter is used",
            "name the right one with --camera NAME=COLOR,DEPTH,INFO",
        )
        for rival in found.of_type(CAMERA_INFO)
        if _is_rival(rival, camera, chosen)
    ]


def _is_rival(entry: TopicSurvey, camera: CameraTopics, chosen: Calibration) -> bool:
    other = entry.calibration
    if other is None or entry.topic.name in (camera.info, camera.depth_info):
        return False
    is_same_view = (other.width, other.height, other.frame_id) == (chosen.width, chosen.height, chosen.frame_id)
    return is_same_view and not np.allclose(other.K, chosen.K, rtol=1e-3)


def tf_findings(found: Survey, cameras: Sequence[CameraTopics], options: SourceOptions) -> Iterator[Finding]:
    """Findings on separate trees, and on frames with two parents."""
    roots = found.tf.roots
    yield from (warning("tf-parents", "tf", text, "let one node publish each frame") for text in found.tf.notes)
    if len(roots) > 1:
        frames = {camera.name: _frame(found, camera.color) for camera in cameras}
        trees = {found.tf.root_of(frame) for frame in frames.values() if frame in found.tf.frames}
        text = f"{len(roots)} separate trees, with roots {', '.join(roots[:6])}"
        if len(trees) > 1 and not options.camera_poses:
            yield error(
                "tf-roots",
                "tf",
                f"{text}; the cameras are in more than one",
                "record the transform that joins them (hand-eye calibration), or choose with --cameras",
            )
        else:
            yield note("tf-roots", "tf", text, "give --world-frame if the wrong one is taken")


def _frame(found: Survey, topic: str) -> str:
    image = found.topics[topic].first_image
    return "" if image is None else image.frame_id


def pose_findings(where: str, stamps_ns: Sequence[int], poses: Sequence[Float64 | None]) -> Iterator[Finding]:
    """Images without pose, and jumps; stamps in order."""
    lost = [stamp for stamp, T in zip(stamps_ns, poses, strict=True) if T is None]
    if lost:
        share = f"{len(lost)} of {len(poses)} images have no pose"
        severity = error if len(lost) == len(poses) else warning
        yield severity("pose-missing", where, share, value=len(lost), stamp_ns=lost[0])
    known = [(s, T[:3, 3]) for s, T in zip(stamps_ns, poses, strict=True) if T is not None]
    steps = [
        (float(np.linalg.norm(b - a)), first)
        for (first, a), (last, b) in pairwise(known)
        if last - first <= TF_GAP_NS
    ]
    if steps:
        longest, at = max(steps)
        median = float(np.median([step for step, _ in steps]))
        if longest > max(limits.POSES_JUMP, limits.POSES_JUMP_RATIO * median):
            yield error(
                "pose-jump",
                where,
                f"the camera jumps by {longest:.3g} m from one frame to the next (median {median:.2g} m)",
                value=longest,
                unit="m",
                stamp_ns=at,
            )


def camera_findings(
    found: Survey, topics: CameraTopics, camera: Camera | None, options: SourceOptions
) -> Iterator[Finding]:
    """Pairs, lens and poses of one camera."""
    yield from _pairing(found, topics, options)
    yield from _lens(found, topics, options)
    if camera is None or camera.fixed_pose is not None:
        return
    stamps = sorted(found.topics[topics.color].stamps_ns)[: limits.POSES_LOOKED_UP]
    tolerance_ns = round(options.pose_tolerance_s * 1e9)
    yield from pose_findings(
        f"camera {topics.name}", stamps, [camera.pose_at(found.tf, stamp, tolerance_ns) for stamp in stamps]
    )


def _pairing(found: Survey, camera: CameraTopics, options: SourceOptions) -> Iterator[Finding]:
    where = f"camera {camera.name}"
    color, depth = (found.topics[t].stamps_ns[: limits.PAIRED_STAMPS] for t in (camera.color, camera.depth))
    pairs = paired(color, depth, round(options.pairing_tolerance_s * 1e9)).tolist()
    rarer, other = sorted((len(color), len(depth)))
    if not pairs or not rarer:
        gap = nearest_gap_ns(color, depth) * 1e-9
        yield error(
            "pairing",
            where,
            f"no colour image has a depth image of its time; the closest are {1e3 * gap:.4g} ms apart",
            f"give --pairing-tolerance {gap * 1.01 + 1e-4:.3g} (seconds), if that is right",
            value=1e3 * gap,
            unit="ms",
        )
        return
    if len(pairs) < limits.PAIRED_SHARE * rarer:
        yield warning(
            "pairing",
            where,
            f"{len(pairs)} of {rarer} images find a partner within {1e3 * options.pairing_tolerance_s:g} ms",
            "let the driver synchronise colour and depth, or give --pairing-tolerance",
            value=len(pairs) / rarer,
        )
    is_all = max(len(color), len(depth)) < limits.PAIRED_STAMPS
    if other > limits.RATE_SLOWER * rarer and rarer >= limits.RATE_FEWEST and is_all:
        names = ("depth", "colour") if len(depth) < len(color) else ("colour", "depth")
        yield note(
            "rates-differ",
            where,
            f"{rarer} {names[0]} images to {other} of {names[1]}: {other - len(pairs)} {names[1]} images go unused",
            value=rarer / other,
        )
    offset = float(np.median([depth[j] - color[i] for i, j in pairs])) * 1e-9
    if abs(offset) > limits.PAIRED_LATE:
        yield note(
            "pair-offset",
            where,
            f"depth is stamped {1e3 * offset:+.1f} ms against its colour image (median)",
            value=1e3 * offset,
            unit="ms",
        )


def _lens(found: Survey, topics: CameraTopics, options: SourceOptions) -> Iterator[Finding]:
    """Findings on the lens in use, and on depth's own."""
    where, image = f"camera {topics.name}", found.topics[topics.color].first_image
    given = options.intrinsics.get(topics.name)
    if given is not None and image is not None:
        fx, fy, cx, cy = given[:4]
        return lens_findings(
            where, Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=image.width, height=image.height), "--intrinsics"
        )
    names = dict.fromkeys(name for name in (topics.info, topics.depth_info) if name)
    known = [(name, its) for name in names if (its := found.topics[name].calibration) is not None and its.width]
    return (finding for name, its in known for finding in lens_findings(where, intrinsics_of(its), name))
