"""Opens any recorded input as records in time order."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from splatctrl_cli.captures.capture import CaptureSource, robot_description_of
from splatctrl_cli.captures.capture_header import is_capture
from splatctrl_cli.containers.log_formats import SessionLog, open_raw_log
from splatctrl_cli.containers.raw_log import RawLog
from splatctrl_cli.datasets.image_folder import ImageFolderSource, open_image_folder
from splatctrl_cli.datasets.layouts import has_views, open_layout
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.ros_log import RosLogSource
from splatctrl_cli.logs.source_options import CameraTopics, SourceOptions
from splatctrl_cli.logs.stored_frame import FrameSource
from splatctrl_cli.logs.survey import RobotDescription, robot_descriptions
from splatctrl_cli.logs.video import open_log
from splatctrl_cli.sources.calibrated import calibrated

__all__ = ["CameraTopics", "SourceOptions", "open_logs", "open_session", "open_source"]


def open_source(path: Path, options: SourceOptions | None = None, *, needs_depth: bool = True) -> FrameSource:
    """The records of an MCAP, ROS 1 or ROS 2 bag, capture folder, dataset folder or file, or image folder's
    TOML description.

    Raises InputError where there is nothing, or nothing that can be used, as images without depth where it is needed.
    """
    options = options or SourceOptions()
    if not path.exists():
        raise InputError(f"{path}: no such file or folder", remedy="check the path")
    return calibrated(_opened(path, options, needs_depth=needs_depth), options)


def _opened(path: Path, options: SourceOptions, *, needs_depth: bool) -> FrameSource:
    """As recorded."""
    if path.suffix == ".toml" or (not is_capture(path) and has_views(path)):
        source = open_image_folder(path, options) if path.suffix == ".toml" else open_layout(path, options)
        if needs_depth and (refusal := lacks_depth(source)) is not None:
            raise refusal
        return source
    if is_capture(path):
        return CaptureSource(path, options)
    return RosLogSource(open_log(path), options)


def lacks_depth(source: FrameSource) -> InputError | None:
    """What to say where a recording is without depth, as only images in a folder may be."""
    return source.no_depth() if isinstance(source, ImageFolderSource) and not source.has_depth else None


def open_session(paths: Sequence[Path], options: SourceOptions | None = None) -> FrameSource:
    """The records of one input, or of several logs that were recorded at the same time.

    Raises InputError as `open_source`, and where one of several is not a log.
    """
    log = open_logs(paths)
    options = options or SourceOptions()
    return open_source(paths[0], options) if log is None else calibrated(RosLogSource(log, options), options)


def logged_descriptions(paths: Sequence[Path]) -> list[tuple[Path, RobotDescription]]:
    """What logs and captures of one session say of the robot, each text once, with the path that says it; other
    recordings, and what cannot be opened, say nothing.
    """
    found: dict[str, tuple[Path, RobotDescription]] = {}
    for path in paths:
        said = []
        if is_capture(path):
            said = robot_description_of(path)
        elif path.exists() and not has_views(path):
            with suppress(InputError):  # who reads it says why
                said = robot_descriptions(open_raw_log(path))
        for description in said:
            found.setdefault(description.text, (path, description))
    return list(found.values())


def open_logs(paths: Sequence[Path]) -> RawLog | None:
    """A log, or several of one session as one; None for a single path that is not a log.

    Raises InputError where there is nothing, and where one of several is not a log.
    """
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder", remedy="check the path")
        if path.suffix == ".toml" or is_capture(path) or has_views(path):
            if len(paths) == 1:
                return None
            raise InputError(f"{path}: expected a log beside others, got none", remedy="give it alone")
    logs = tuple(open_log(path) for path in paths)
    return logs[0] if len(logs) == 1 else SessionLog(logs)
