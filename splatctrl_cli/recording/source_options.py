"""The options for reading a source."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from splatctrl_cli.errors import refuse_if

CALIBRATION = "--calibration "  # begins the name of a calibration among the files that were read
NUM_COEFFICIENTS = (4, 5, 8, 12, 14)  # of a distortion, that OpenCV takes
PERTURB = "--perturb "  # likewise, what was done to them


@dataclass(frozen=True, kw_only=True)
class CameraTopics:
    """An RGB-D camera's topics; an empty info or depth_info was not found.

    rivals: topics that could equally be its depth.
    """

    name: str
    color: str
    depth: str
    info: str = ""
    depth_info: str = ""
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """The user's settings for an input; the defaults fit a well-formed log.

    world_frame: of poses (default: tf's root). cameras: only these (default: all). camera_topics: the user's.
    Mappings are by camera name. camera_poses: fixed T_world_camera as x, y, z, qx, qy, qz, qw. camera_pose_topics:
    topic if tf has none, and the frame that it poses or "". human_topics: images, not 0 on a person. intrinsics: fx,
    fy, cx, cy [px] and distortion coefficients. depth_scale [m per count]. root: of an image folder's files. holdout:
    frames (index or name) of camera `holdout`. stamps: ``header`` or ``log``. calibration: a file of `calibrate`.
    perturb: sizes of errors by name (`Perturbation`).
    """

    world_frame: str | None = None
    cameras: tuple[str, ...] | None = None
    camera_topics: tuple[CameraTopics, ...] = ()
    camera_poses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    camera_pose_topics: Mapping[str, tuple[str, str]] = field(default_factory=dict)
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
        """Raise InputError if an option of `names` is set: they do not apply to `kind`."""
        flags = {
            "camera_topics": "camera",
            "human_topics": "human-topic",
            **dict.fromkeys(["camera_poses", "camera_pose_topics"], "camera-pose"),
        }
        default = SourceOptions()
        for name in names:
            flag = flags.get(name, name.replace("_", "-"))
            is_split = (name, kind) == ("holdout", "a capture")
            refuse_if(
                getattr(self, name) != getattr(default, name),
                f"{path}: --{flag} does not apply to {kind}",
                remedy="give it to `splatctrl ingest`, which makes a camera `holdout` of these views"
                if is_split
                else "leave it out",
            )


still_note = "camera {}: is fixed where --camera-pose puts it, not where the recording may say".format


def refuse_unknown_cameras(where: Path, requested: Iterable[str], known: Collection[str]) -> None:
    """Raise InputError for a requested camera not in the recording."""
    for name in requested:
        refuse_if(name not in known, f"{where}: no camera {name!r}", remedy=f"use one of: {', '.join(known)}")
