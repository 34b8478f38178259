"""Checks of a log in one pass."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import chain

from splatctrl_cli.checks.check_cameras import calibration_findings, camera_findings, tf_findings
from splatctrl_cli.checks.check_folder import Evidence, judged
from splatctrl_cli.checks.check_images import depth_findings, image_findings, sample_findings
from splatctrl_cli.checks.check_states import log_states
from splatctrl_cli.checks.check_times import (
    clock_findings,
    ending_findings,
    file_findings,
    joined_gaps,
    part_findings,
    peer_findings,
    time_findings,
)
from splatctrl_cli.checks.finding import CheckReport, Finding, Severity, damage_findings, error, needs, note, warning
from splatctrl_cli.checks.log_pass import LogWatch, image_motion, ready, reduced_frames
from splatctrl_cli.recording.calibrated import correction_of
from splatctrl_cli.recording.container.raw_log import RawLog
from splatctrl_cli.recording.log.cameras import image_topics
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, TRANSFORMS
from splatctrl_cli.recording.log.messages import COLOR_CONVERSIONS, DEPTH_ENCODINGS
from splatctrl_cli.recording.log.rig import camera_topics, check_mask_topics, missing
from splatctrl_cli.recording.log.state_messages import STATE_TYPES
from splatctrl_cli.recording.log.survey import Survey, survey
from splatctrl_cli.recording.source_options import CameraTopics, SourceOptions, refuse_unknown_cameras
from splatctrl_cli.robot.model import RobotModel

IMAGES = (IMAGE, COMPRESSED_IMAGE)
SAID = (" are never closer than ", " images as ", "distortion model ", " says rectified")  # other findings name them


def check_log(
    log: RawLog,
    options: SourceOptions,
    *,
    model: RobotModel | None = None,
    num_images: int | None = None,
    only_errors: bool = False,
) -> CheckReport:
    """Check `log` in one pass and bounded memory; at most `num_images` per topic.

    Raises InputError for unfitting options.
    """
    options.refuse(("root", "holdout"), "a log", log.path)
    watch = LogWatch(log, options, num_images)
    found = survey(watch, by_log_time=options.stamps == "log")
    findings = damage_findings(log.path.name, found.damage.notes)
    findings += [note("remark", log.path.name, text, value=num) for text, num in found.damage.remarks.items()]
    findings += file_findings(watch.spans)
    cameras = _chosen(log, found, options)
    rig = [(topics, ready(log, found, topics, options)) for topics in cameras]
    for topics, camera in rig:
        if camera is not None and camera.depth_scale is not None and topics.depth in watch.images:
            watch.images[topics.depth].rescale(camera.depth_scale)
    findings += _time_findings(watch, found, cameras)
    findings += _image_findings(watch, cameras, {t.topic.name for t in image_topics(found, "unlike")})
    findings += calibration_findings(found, cameras, watch.changed_infos)
    findings += tf_findings(found, cameras, options)
    for topics, camera in rig:
        findings += camera_findings(found, topics, camera, options)
    if any(finding.code == "pose-missing" for finding in findings):
        findings = [finding for finding in findings if finding.code != "tf-ends"]  # the same, from its cause
    findings += [error("missing", log.path.name, *_parted(lack)) for lack in _lacks(log, found, options)]
    correction = correction_of(options, log.path.name)
    late_ns = {c.name: correction.late_ns(c.name) for _, c in rig if correction is not None and c is not None}
    whole = [(topics, camera) for topics, camera in rig if camera is not None]
    frames = {c.name: reduced_frames(t, c, watch.images, found.tf, options, late_ns) for t, c in whole}
    of_states = log_states(found, options, model)
    if correction is not None:
        frames = {name: list(map(correction.frame, its)) for name, its in frames.items()}
        if of_states.states is not None:
            of_states = replace(of_states, states=correction.states(of_states.states))
    first, last = _span(found)
    report = CheckReport(
        path=str(log.path),
        kind=log.container,
        duration_s=(last - first) * 1e-9,
        num_messages=found.num_messages,
        start_ns=watch.first_ns,
        findings=[*findings, *of_states.findings],
        rates=[
            t.rate(is_read=found.topics[name].topic.type_name in (*IMAGES, CAMERA_INFO, *STATE_TYPES, *TRANSFORMS))
            for name, t in sorted(watch.times.items())
        ],
        needs=needs(
            num_cameras=len(cameras),
            num_frames=max((images.count for images in watch.images.values()), default=0),
            states_lack=of_states.lack,
        ),
    )
    return judged(
        report,
        Evidence(
            frames=list(chain.from_iterable(frames.values())),
            depth_units={c.name: watch.images[t.depth].unit for t, c in whole if frames[c.name]},
            motion=image_motion(watch, whole, frames),
            states=of_states.states,
            cut="" if watch.is_whole else f"only the first {num_images} images of a topic were read",
        ),
        of_states.model,
        only_errors=only_errors,
    )


def _chosen(log: RawLog, found: Survey, options: SourceOptions) -> tuple[CameraTopics, ...]:
    """The selected cameras. Raises InputError for unknown ones."""
    cameras = camera_topics(log, found, options)
    names = tuple(camera.name for camera in cameras)
    if not names:
        return ()
    refuse_unknown_cameras(log.path, (*(options.cameras or ()), *options.camera_poses, *options.intrinsics), names)
    check_mask_topics(log.path, found, options.human_topics, names)
    return tuple(c for c in cameras if options.cameras is None or c.name in options.cameras)


def _lacks(log: RawLog, found: Survey, options: SourceOptions) -> list[str]:
    """Obstacles to `ingest` that no other finding names."""
    if not found.num_messages:
        damage = "nothing usable before the damage" if found.damage.count else "the log holds no messages"
        return [f"{damage}; record it again, or give another file"]
    return [lack for lack in missing(log, found, options) if not any(words in lack for words in SAID)]


def _parted(lack: str) -> tuple[str, str]:
    what, _, remedy = lack.rpartition("; ")
    return (what, remedy) if what else (remedy, "")


def _span(found: Survey) -> tuple[int, int]:
    entries = [t for t in found.topics.values() if t.count]
    return min((t.first_log_ns for t in entries), default=0), max((t.last_log_ns for t in entries), default=0)


def _time_findings(watch: LogWatch, found: Survey, cameras: Sequence[CameraTopics]) -> list[Finding]:
    names = [n for n, e in sorted(found.topics.items()) if e.topic.type_name in (*IMAGES, *STATE_TYPES)]
    times = [watch.times[n] for n in names if n in watch.times and not _is_beside(watch, n, cameras)]
    each = [f for t in times for f in time_findings(t, "images" if t.topic in watch.images else "states")]
    each += [
        replace(f, code="tf-gap") if f.code == "gap" else f
        for edge in watch.transforms.values()
        for f in time_findings(edge, "transforms")
    ]
    last_ns = max((t.last_ns for t in times if t.topic in watch.images), default=0)
    peers = [[watch.times[getattr(camera, kind)] for camera in cameras] for kind in ("color", "depth")]
    clocks = clock_findings(times)
    said = {finding.where for finding in clocks if finding.code == "clock-offset"}
    clocks += [f for topics in peers for f in peer_findings(topics) if f.where not in said]
    return [
        *joined_gaps(each),
        *(part_findings(times) if not any(f.code in {"clock", "clock-offset"} for f in clocks) else ()),
        *clocks,
        *ending_findings(list(watch.transforms.values()), last_ns),
    ]


def _is_beside(watch: LogWatch, name: str, cameras: Sequence[CameraTopics]) -> bool:
    """True if no camera uses a topic's images."""
    return bool(cameras) and name in watch.images and not any(name in (c.color, c.depth) for c in cameras)


def _image_findings(watch: LogWatch, cameras: Sequence[CameraTopics], unlike: Collection[str]) -> list[Finding]:
    """Findings on image topics; notes if no camera uses them. unlike: topics with only depth's encoding."""
    findings = []
    for name, images in sorted(watch.images.items()):
        its = list(image_findings(images))
        kinds = set(images.encodings)
        unread = sorted(kinds - set(DEPTH_ENCODINGS) - set(COLOR_CONVERSIONS))
        if unread:
            known = ", ".join((*COLOR_CONVERSIONS, *DEPTH_ENCODINGS))
            its.append(
                warning(
                    "encoding",
                    name,
                    f"encoding {unread[0]!r} is not read",
                    f"record another topic of this camera, or convert it; read: {known}",
                )
            )
        if _is_beside(watch, name, cameras):
            its = [replace(f, severity=Severity.NOTE, what=f"{f.what}; no camera uses the topic") for f in its]
        elif kinds & set(DEPTH_ENCODINGS) and images.num_decoded and name not in unlike:
            its += depth_findings(images)
        findings += its
    return [*findings, *sample_findings(list(watch.images.values()))]
