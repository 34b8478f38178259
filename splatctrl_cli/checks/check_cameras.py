"""Checks of cameras: colour-depth pairs, intrinsics, distortion and poses."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from splatctrl_cli.checks import limits
from splatctrl_cli.checks.finding import ERROR, NOTE, WARNING, Finding, error, judge, warning
from splatctrl_cli.config.fixed import TF_GAP_NS
from splatctrl_cli.recording.log.decoder import CAMERA_INFO
from splatctrl_cli.recording.log.registration import DISTORTION_MODELS, is_distorted, lens_model
from splatctrl_cli.recording.log.rig import Camera, ImageLens, image_lens, intrinsics_of, nearest_gap_ns
from splatctrl_cli.recording.log.survey import Calibration, Survey, pair_images
from splatctrl_cli.recording.source_options import NUM_COEFFICIENTS, CameraTopics, SourceOptions
from splatctrl_cli.records import Float64, Intrinsics

_DONE: Mapping[ImageLens, str] = {
    "distorted": "undistorts",
    "rectified": "takes P for the rectified",
    "contradicted": "refuses",
}
NUM_DISTORTION = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


def lens_findings(where: str, lens: Intrinsics, source: str = "") -> list[Finding]:
    """Findings on intrinsics by image size; source: their origin."""
    says = f"{source}: " if source else ""
    remedy = "calibrate again, or give the CameraInfo of this very stream (a crop or another size has its own)"
    off = [(c + 0.5) / size - 0.5 for c, size in ((lens.cx, lens.width), (lens.cy, lens.height))]
    worst, times = max(off, key=abs), [2 * (share + 0.5) for share in off]
    is_off, factor, ratio = abs(worst) > limits.LENS_CENTRE, float(np.mean(times)), lens.fx / lens.fy
    is_of_other_size = is_off and abs(times[0] / times[1] - 1) < limits.LENS_SAME_FACTOR
    centre = f"{says}cx, cy = {lens.cx:.1f}, {lens.cy:.1f} px of {lens.width}x{lens.height}"
    centre = f"{centre}: {100 * abs(worst):.0f} % off the middle of the image"
    other = f", as if calibrated at about {factor * lens.width:.0f}x{factor * lens.height:.0f}"
    angle, (low, high) = math.degrees(2 * math.atan(0.5 * lens.width / lens.fx)), limits.LENS_FIELD_OF_VIEW
    return [
        *judge(
            ERROR if is_of_other_size else WARNING if is_off else None,
            "principal-point",
            where,
            f"{centre}{other}" if is_of_other_size else centre,
            f"scale K by {1 / factor:.3g}, or {remedy}" if is_of_other_size else remedy,
            value=round(100 * worst, 1),
            unit="%",
        ),
        *judge(
            WARNING if abs(ratio - 1) > limits.LENS_RATIO else None,
            "focal-ratio",
            where,
            f"{says}fx / fy = {ratio:.3f} ({lens.fx:.1f}, {lens.fy:.1f} px): pixels are square in every RGB-D camera",
            remedy,
            value=ratio,
        ),
        *judge(
            None if low <= angle <= high else WARNING,
            "field-of-view",
            where,
            f"{says}field of view {angle:.0f} deg (fx {lens.fx:.1f} of {lens.width} px):"
            f" expected {low:g} to {high:g}",
            remedy,
            value=angle,
            unit="deg",
        ),
    ]


def calibration_findings(
    survey: Survey, cameras: Sequence[CameraTopics], changed: dict[str, int]
) -> Iterator[Finding]:
    """Findings on CameraInfo; `changed`: stamps of first changes."""
    unset = NOTE if cameras and all(camera.info for camera in cameras) else WARNING
    for entry in survey.select_types(CAMERA_INFO):
        name, is_unset = entry.topic.name, entry.calibration is None
        text = "K is zero: the camera was never calibrated"
        yield from judge(unset if is_unset else None, "uncalibrated", name, text)
        text = "the CameraInfo changes within the log; the first is used for all frames"
        is_changed = not is_unset and name in changed
        yield from judge(
            WARNING if is_changed else None, "camera-info-changes", name, text, stamp_ns=changed.get(name)
        )
    for topic, info in dict.fromkeys(
        [(c.color, c.info) for c in cameras] + [(c.depth, c.depth_info) for c in cameras]
    ):
        its = survey.topics[info].calibration if info else None
        if its is not None:
            yield from _distortion(info, its, topic, image_lens(survey, topic, its))
    for camera in cameras:
        for topic, info in ((camera.color, camera.info), (camera.depth, camera.depth_info or camera.info)):
            image, its = survey.topics[topic].first_image, survey.topics[info].calibration if info else None
            if image is not None and its is not None and its.width:
                size, expected = (f"{one.width}x{one.height}" for one in (image, its))
                text = f"{topic} is {size}, its CameraInfo {expected}"
                yield from judge(ERROR if size != expected else None, "camera-info-size", info, text)
        yield from _rivals(survey, camera)


def _distortion(name: str, calibration: Calibration, topic: str, lens: ImageLens) -> list[Finding]:
    d, model = calibration.distortion, lens_model(calibration.distortion_model)
    if not is_distorted(model, d):
        return []
    if model not in DISTORTION_MODELS:
        remedy = f"rectify the images first; known: {', '.join(DISTORTION_MODELS)}"
        return [error("distortion", name, f"distortion model {model!r} is unknown", remedy)]
    if len(d) not in NUM_DISTORTION[model]:
        is_read = len(d) in NUM_COEFFICIENTS if model != "equidistant" else len(d) > 4 and not np.any(d[4:])
        text = f"{model} with {len(d)} coefficients, expected {' or '.join(map(str, NUM_DISTORTION[model]))}"
        return judge(WARNING if is_read else ERROR, "distortion", name, text, "calibrate again", value=len(d))
    is_doubtful = lens == "distorted" and topic.endswith("rect_raw")
    severity = ERROR if lens == "contradicted" else WARNING if is_doubtful else NOTE
    text = f"{model} ({', '.join(f'{v:.4g}' for v in d[:5])}): ingest {_DONE[lens]} {topic}"
    remedy = "give --intrinsics NAME=FX,FY,CX,CY if the images are rectified"
    remedies = {ERROR: f"{remedy}, with D1,D2,... behind it if not", WARNING: remedy, NOTE: ""}
    says = "" if severity is NOTE else ", whose name says rectified"
    return judge(severity, "distortion", name, f"{text}{says}", remedies[severity])


def _rivals(survey: Survey, camera: CameraTopics) -> Iterator[Finding]:
    chosen = survey.topics[camera.info].calibration if camera.info else None
    for entry in survey.select_types(CAMERA_INFO):
        name, other = entry.topic.name, entry.calibration
        if chosen is None or other is None or name in (camera.info, camera.depth_info):
            continue
        is_same_view = (other.width, other.height, other.frame_id) == (chosen.width, chosen.height, chosen.frame_id)
        yield from judge(
            WARNING if is_same_view and not np.allclose(other.K, chosen.K, rtol=1e-3) else None,
            "camera-info-two",
            f"camera {camera.name}",
            f"{name} has the frame and size of {camera.info}, but another K: the latter is used",
            "name the right one with --camera NAME=COLOR,DEPTH,INFO",
        )


def tf_findings(survey: Survey, cameras: Sequence[CameraTopics], options: SourceOptions) -> Iterator[Finding]:
    """Findings on separate trees, and on frames with two parents."""
    tf, roots = survey.tf, survey.tf.roots
    yield from (warning("tf-parents", "tf", text, "let one node publish each frame") for text in tf.notes)
    images = [survey.topics[camera.color].first_image for camera in cameras]
    trees = {tf.root_of(image.frame_id) for image in images if image is not None and image.frame_id in tf.frames}
    text = f"{len(roots)} separate trees, with roots {', '.join(roots[:6])}"
    is_parted = len(trees) > 1 and not options.camera_poses
    yield from judge(
        None if len(roots) < 2 else ERROR if is_parted else NOTE,
        "tf-roots",
        "tf",
        f"{text}; the cameras are in more than one" if is_parted else text,
        "record the transform that joins them (hand-eye calibration), or choose with --cameras"
        if is_parted
        else "give --world-frame if the wrong one is taken",
    )


def pose_findings(where: str, stamps_ns: Sequence[int], poses: Sequence[Float64 | None]) -> Iterator[Finding]:
    """Images without pose, and jumps; stamps in order."""
    lost = [stamp for stamp, T in zip(stamps_ns, poses, strict=True) if T is None]
    yield from judge(
        None if not lost else ERROR if len(lost) == len(poses) else WARNING,
        "pose-missing",
        where,
        f"{len(lost)} of {len(poses)} images have no pose",
        value=len(lost),
        stamp_ns=next(iter(lost), None),
    )
    known = [(s, T[:3, 3]) for s, T in zip(stamps_ns, poses, strict=True) if T is not None]
    steps = [
        (float(np.linalg.norm(b - a)), first)
        for (first, a), (last, b) in pairwise(known)
        if last - first <= TF_GAP_NS
    ]
    longest, at = max(steps, default=(0.0, 0))
    median = float(np.median([step for step, _ in steps] or [0.0]))
    yield from judge(
        ERROR if longest > max(limits.POSES_JUMP, limits.POSES_JUMP_RATIO * median) else None,
        "pose-jump",
        where,
        f"the camera jumps by {longest:.3g} m from one frame to the next (median {median:.2g} m)",
        value=longest,
        unit="m",
        stamp_ns=at,
    )


def camera_findings(
    survey: Survey, topics: CameraTopics, camera: Camera | None, options: SourceOptions
) -> Iterator[Finding]:
    yield from _pairing(survey, topics, options)
    yield from _lens(survey, topics, options)
    if camera is None or camera.fixed_pose is not None:
        return
    stamps = sorted(survey.topics[topics.color].stamps_ns)[: limits.POSES_LOOKED_UP]
    tolerance_ns = round(options.pose_tolerance_s * 1e9)
    yield from pose_findings(
        f"camera {topics.name}", stamps, [camera.pose_at(survey.tf, stamp, tolerance_ns) for stamp in stamps]
    )


def _pairing(survey: Survey, camera: CameraTopics, options: SourceOptions) -> list[Finding]:
    where, tolerance = f"camera {camera.name}", options.pairing_tolerance_s
    color, depth = (survey.topics[t].stamps_ns[: limits.PAIRED_STAMPS] for t in (camera.color, camera.depth))
    pairs = pair_images(color, depth, round(tolerance * 1e9)).tolist()
    rarer, other = sorted((len(color), len(depth)))
    if not pairs or not rarer:
        gap = nearest_gap_ns(color, depth) * 1e-9
        text = f"no colour image has a depth image of its time; the closest are {1e3 * gap:.4g} ms apart"
        remedy = f"give --pairing-tolerance {gap * 1.01 + 1e-4:.3g} (seconds), if that is right"
        return [error("pairing", where, text, remedy, value=1e3 * gap, unit="ms")]
    is_all = max(len(color), len(depth)) < limits.PAIRED_STAMPS
    is_slower = other > limits.RATE_SLOWER * rarer and rarer >= limits.RATE_FEWEST and is_all
    names = ("depth", "colour") if len(depth) < len(color) else ("colour", "depth")
    offset = float(np.median([depth[j] - color[i] for i, j in pairs])) * 1e-9
    return [
        *judge(
            WARNING if len(pairs) < limits.PAIRED_SHARE * rarer else None,
            "pairing",
            where,
            f"{len(pairs)} of {rarer} images find a partner within {1e3 * tolerance:g} ms",
            "let the driver synchronise colour and depth, or give --pairing-tolerance",
            value=len(pairs) / rarer,
        ),
        *judge(
            NOTE if is_slower else None,
            "rates-differ",
            where,
            f"{rarer} {names[0]} images to {other} of {names[1]}: {other - len(pairs)} {names[1]} images go unused",
            value=rarer / other,
        ),
        *judge(
            NOTE if abs(offset) > limits.PAIRED_LATE else None,
            "pair-offset",
            where,
            f"depth is stamped {1e3 * offset:+.1f} ms against its colour image (median)",
            value=1e3 * offset,
            unit="ms",
        ),
    ]


def _lens(survey: Survey, topics: CameraTopics, options: SourceOptions) -> list[Finding]:
    where, image = f"camera {topics.name}", survey.topics[topics.color].first_image
    option = options.intrinsics.get(topics.name)
    if option is not None and image is not None:
        fx, fy, cx, cy = option[:4]
        return lens_findings(
            where, Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=image.width, height=image.height), "--intrinsics"
        )
    names = dict.fromkeys(name for name in (topics.info, topics.depth_info) if name)
    known = [(name, its) for name in names if (its := survey.topics[name].calibration) is not None and its.width]
    return [finding for name, its in known for finding in lens_findings(where, intrinsics_of(its), name)]
