"""Image folders of one camera or of several, whose description has ``[[cameras]]``."""

import heapq
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

from splatctrl_cli.datasets.folder_description import read_rig
from splatctrl_cli.datasets.image_folder import ImageFolderSource
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.logs.shot import Shot
from splatctrl_cli.records import Float64, JointState, LossReport, Record


def open_image_folder(path: Path, options: SourceOptions) -> "ImageFolderSource | RigFolderSource":
    """The records that a TOML description names."""
    return RigFolderSource(path, options) if read_rig(path, options.root) else ImageFolderSource(path, options)


class RigFolderSource:
    """Records of several cameras by stamp, each camera an image folder of its own; no joint states."""

    joint_names: tuple[str, ...] = ()
    world_frame = "world"

    def __init__(self, path: Path, options: SourceOptions) -> None:
        options.refuse(("holdout", "intrinsics", "camera_pose_topics"), "a description with several cameras", path)
        self.name = path.name
        by_name = {}
        for description in read_rig(path, options.root):
            assert description.camera is not None
            name = description.camera.name
            pose = {name: options.camera_poses[name]} if name in options.camera_poses else {}
            by_name[name] = ImageFolderSource(path, replace(options, cameras=None, camera_poses=pose), description)
        for name in (*(options.cameras or ()), *options.camera_poses):
            if name not in by_name:
                raise InputError(f"{path}: no camera {name!r}", remedy=f"use one of: {', '.join(by_name)}")
        self.cameras = options.cameras or tuple(by_name)
        self._parts = [by_name[name] for name in self.cameras]

    @property
    def has_clock(self) -> bool:
        """Whether the description says when the images were taken."""
        return self._parts[0].has_clock

    @property
    def loss(self) -> LossReport:
        """That of all cameras together."""
        losses = [part.loss for part in self._parts]
        counts = {
            f.name: sum(getattr(loss, f.name) for loss in losses) for f in fields(LossReport) if f.name != "notes"
        }
        return LossReport(**counts, notes=[note for loss in losses for note in loss.notes])

    def records(self) -> Iterator[Record]:
        """Frames by stamp."""
        for item in self.shots():
            yield item.frame if isinstance(item, Shot) else item

    def shots(self) -> Iterator[Shot | JointState]:
        """Shots by stamp, of the same stamp by camera."""
        return heapq.merge(*(part.shots() for part in self._parts), key=_stamp_ns)

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Of every view."""
        return heapq.merge(*(part.poses() for part in self._parts), key=lambda pose: pose[0])

    def count_views(self) -> dict[str, int]:
        """Views by camera."""
        return {name: count for part in self._parts for name, count in part.count_views().items()}

    def digests(self) -> dict[str, str]:
        """sha256 of the description, the pose files and the images, by path below the root."""
        return {name: digest for part in self._parts for name, digest in part.digests().items()}


def _stamp_ns(item: Shot | JointState) -> int:
    return item.stamp_ns
