"""How a source is to be read."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from splatctrl_cli.errors import InputError

CALIBRATION = "--calibration "  # begins the name of a calibration among the files that were read
NUM_COEFFICIENTS = (4, 5, 8, 12, 14)  # of a distortion, that OpenCV takes
PERTURB = "--perturb "  # likewise, what was done to them


@dataclass(frozen=True, kw_only=True)
class CameraTopics:
    """The topics of one RGB-D camera; an empty info or depth_info means that none was found. rivals: topics that
    could each be its depth, where nothing tells which is.
    """

    name: str
    color: str
    depth: str
    info: str = ""
    depth_info: str = ""
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class PoseTopic:
    """A topic of poses; frame: what it poses, "" for the frame that its messages name, else the camera's own."""

    topic: str
    frame: str = ""


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """What a person may say about an input; every field has a default that fits a well-formed log.

    world_frame: frame of poses (default: the root of the tf tree). cameras: only these (default: all).
    camera_topics: topics by camera name, instead of those found. camera_poses: T_world_camera of fixed cameras as
    x, y, z, qx, qy, qz, qw, instead of those recorded. camera_pose_topics: topics of poses by camera name, where tf
    has none. human_topics: image topics by camera name, not 0 where a pixel shows a person. intrinsics: fx, fy, cx,
    cy [px] and the coefficients of a distortion by camera name, instead of those recorded. depth_scale: [m per count]
    of depth images. root: folder of an image folder's files. holdout: frames (index or name) of an image folder that
    become camera `holdout`. stamps: ``header``, or ``log`` for the times of logging. calibration: what `calibrate`
    wrote of the recording. perturb: what is done to its frames, by name (`calibrated`).
    """

    world_frame: str | None = None
    cameras: tuple[str, ...] | None = None
    camera_topics: tuple[CameraTopics, ...] = ()
    camera_poses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    camera_pose_topics: Mapping[str, PoseTopic] = field(default_factory=dict)
    human_topics: Mapping[str, str] = field(default_factory=dict)
    intrinsics: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    depth_scale: float | None = None
    pairing_tolerance_s: float = 0.020
    pose_tolerance_s: float = 0.020
    joint_topic: str | None = None
    root: Path | None = None
    holdout: tuple[str, ...] | None = None
    stamps: str = "header"
    calibration: Path | None = None
    perturb: Mapping[str, float] = field(default_factory=dict)

    def refuse(self, names: tuple[str, ...], kind: str, path: Path) -> None:
        """Raise InputError where a person gave an option that means nothing for this kind of input."""
        flags = {"camera_topics": "camera", "human_topics": "human-topic"}
        flags |= dict.fromkeys(["camera_poses", "camera_pose_topics"], "camera-pose")
        default = SourceOptions()
        for name in names:
            if getattr(self, name) != getattr(default, name):
                flag = flags.get(name, name.replace("_", "-"))
                remedy = "leave it out"
                if (name, kind) == ("holdout", "a capture"):
                    remedy = "give it to `splatctrl ingest`, which makes a camera `holdout` of these views"
                raise InputError(f"{path}: --{flag} does not apply to {kind}", remedy=remedy)


def still_note(camera: str) -> str:
    """What a report says of a camera whose pose a person gave."""
    return f"camera {camera}: stands still where --camera-pose puts it, not where the recording may say"


def refuse_unknown_cameras(where: Path, asked: Iterable[str], known: Collection[str]) -> None:
    """Raise InputError where a camera that was asked for is not among those of a recording."""
    for name in asked:
        if name not in known:
            raise InputError(f"{where}: no camera {name!r}", remedy=f"use one of: {', '.join(known)}")
