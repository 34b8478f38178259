"""Options that say how a recorded input is to be read, for every subcommand that reads one."""

import argparse
import re
from pathlib import Path

from splatctrl_cli.cli.numbers import real, several, whole
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.recording import RecordingRequest
from splatctrl_cli.logs.options import CameraTopics, PoseTopic, SourceOptions


def add_source(parser: argparse.ArgumentParser) -> None:
    """The options of a source, in a group of their own."""
    group = parser.add_argument_group("input")
    group.add_argument("--cameras", type=_Listed("--cameras"), metavar="A,B", help="only these cameras")
    group.add_argument(
        "--camera",
        action="append",
        default=[],
        metavar="NAME=COLOR,DEPTH[,INFO]",
        help="topics of a camera, instead of those found (repeatable)",
    )
    group.add_argument(
        "--camera-pose",
        action="append",
        default=[],
        metavar="NAME=X,Y,Z,QX,QY,QZ,QW",
        help="pose of a fixed camera in the world, instead of the recorded one, or NAME=identity; or"
        " NAME=TOPIC[@FRAME], a topic of poses (Odometry, PoseStamped, ...) of FRAME where tf has none (repeatable)",
    )
    group.add_argument(
        "--intrinsics",
        action="append",
        default=[],
        metavar="NAME=FX,FY,CX,CY",
        help="intrinsics of a camera in pixels, without distortion, instead of the recorded ones (repeatable)",
    )
    group.add_argument(
        "--human-topic",
        action="append",
        default=[],
        metavar="NAME=TOPIC",
        help="mono8 masks of a camera's colour images, not 0 where they show a person (repeatable)",
    )
    group.add_argument("--world-frame", metavar="FRAME", help="tf frame of poses (default: root of the tf tree)")
    group.add_argument(
        "--depth-scale", type=real(1e-9, 1e3, "m"), metavar="M", help="metres per count of depth (default: 0.001)"
    )
    group.add_argument(
        "--pairing-tolerance",
        type=real(0, 3600, "s"),
        default=0.02,
        metavar="S",
        help="colour to depth, seconds (default: 0.02)",
    )
    group.add_argument(
        "--stamps",
        choices=["header", "log"],
        default="header",
        help="a log's times: those of the headers, or of logging (default: header)",
    )
    group.add_argument("--joint-topic", metavar="TOPIC", help="JointState topic (default: /joint_states)")
    group.add_argument("--root", type=Path, metavar="DIR", help="folder of the images that a .toml describes")
    group.add_argument(
        "--holdout",
        type=_Listed("--holdout"),
        metavar="0,6",
        help="frames of an image folder that become camera 'holdout'",
    )


def add_scan(parser: argparse.ArgumentParser) -> None:
    """``--scan``, ``--protocol``, ``--depths`` and ``--downscale``: the options of a DTU scan."""
    parser.add_argument("--scan", metavar="NAME", help="which scan of --dtu (default: the only one)")
    parser.add_argument(
        "--protocol",
        metavar="NAME",
        help="which views train and which are scored: dtu-train, dtu-holdout8, regnerf-3, regnerf-6, regnerf-9, "
        "mvsnerf, holdout:everyN, holdout:everyN+FIRST or holdout:2,5 (docs/score.md)",
    )
    parser.add_argument(
        "--depths", type=Path, metavar="DIR", help="depth_map_0000.pfm and so on of a scan in IDR's layout"
    )
    parser.add_argument(
        "--downscale",
        type=whole(1, 64),
        metavar="N",
        help="make images of --dtu N times smaller (default: down to the size of the protocol, if a whole factor)",
    )


def recording_of(args: argparse.Namespace, path: Path, masks: Path | None = None) -> RecordingRequest:
    """What `add_source` and `add_scan` parsed: the recording at `path`, where there is no --dtu."""
    return RecordingRequest(
        path=args.dtu or path,
        is_dtu=args.dtu is not None,
        options=source_options(args),
        masks=masks,
        **{name: getattr(args, name) for name in ("scan", "protocol", "depths", "downscale")},
    )


def source_options(args: argparse.Namespace) -> "SourceOptions":
    """What `add_source` parsed. Raises UsageError for a value of the wrong form."""
    return SourceOptions(
        world_frame=args.world_frame,
        cameras=_names(args.cameras),
        camera_topics=tuple(_topics(text) for text in args.camera),
        camera_poses=dict(_pose(text) for text in args.camera_pose if not _is_topic(text)),
        camera_pose_topics=dict(_pose_topic(text) for text in args.camera_pose if _is_topic(text)),
        human_topics=dict(_human_topic(text) for text in args.human_topic),
        intrinsics=dict(_lens(text) for text in args.intrinsics),
        depth_scale=args.depth_scale,
        pairing_tolerance_s=args.pairing_tolerance,
        joint_topic=args.joint_topic,
        root=args.root,
        holdout=_names(args.holdout),
        stamps=args.stamps,
    )


class _Listed:
    """A list for argparse, without spaces around its names. Raises UsageError for one that names nothing."""

    def __init__(self, option: str) -> None:
        self.option = option

    def __call__(self, text: str) -> str:
        names = _names(text)
        if not names:
            raise UsageError(f"{self.option} {text!r}: expected names, got none", remedy="leave the option out")
        return ",".join(names)


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(",") if name.strip())


def _topics(text: str) -> "CameraTopics":
    name, equals, rest = text.partition("=")
    topics = rest.split(",")
    if not (re.fullmatch(r"\w[\w.-]*", name) and equals and len(topics) in {2, 3} and all(topics)):
        raise UsageError(f"--camera {text}: expected NAME=COLOR,DEPTH or NAME=COLOR,DEPTH,INFO")
    return CameraTopics(name=name, color=topics[0], depth=topics[1], info=topics[2] if len(topics) == 3 else "")


def _human_topic(text: str) -> tuple[str, str]:
    name, _, topic = text.partition("=")
    if not name or not topic:
        raise UsageError(f"--human-topic {text}: expected NAME=TOPIC")
    return name, topic


def _pose(text: str) -> tuple[str, tuple[float, ...]]:
    name, _, rest = text.partition("=")
    if name and rest == "identity":
        return name, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    values = several(rest)
    if not name or len(values) != 7 or not 0.5 < sum(v * v for v in values[3:]) < 2.0:
        raise UsageError(
            f"--camera-pose {text}: expected NAME=X,Y,Z,QX,QY,QZ,QW with a unit quaternion, or NAME=identity"
        )
    return name, values


def _is_topic(text: str) -> bool:
    return text.partition("=")[2].startswith("/")


def _pose_topic(text: str) -> tuple[str, "PoseTopic"]:
    name, _, rest = text.partition("=")
    topic, at, frame = rest.partition("@")
    if not name or not topic or bool(at) != bool(frame):
        raise UsageError(f"--camera-pose {text}: expected NAME=TOPIC or NAME=TOPIC@FRAME")
    return name, PoseTopic(topic=topic, frame=frame.strip("/"))


def _lens(text: str) -> tuple[str, tuple[float, ...]]:
    name, _, rest = text.partition("=")
    values = several(rest)
    if not name or len(values) != 4 or not min(values[:2]) > 0:
        raise UsageError(f"--intrinsics {text}: expected NAME=FX,FY,CX,CY in pixels")
    return name, values
