"""Any recorded input as records in time order; descriptions of files and folders."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatctrl_cli.calibration.calibration_file import describe_calibration, is_calibration
from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.files.summary import Grid, Summary, files_below, names_in
from splatctrl_cli.formats.grid.grid_format import FORMAT, covers, header_facts
from splatctrl_cli.formats.scene.scene_folder import run_value
from splatctrl_cli.formats.scene.voxel_file import known_space, read_occupancy
from splatctrl_cli.recording.calibrated import calibrated
from splatctrl_cli.recording.capture.capture import (
    CaptureSource,
    is_capture,
    read_capture_header,
    read_robot_description,
)
from splatctrl_cli.recording.capture.capture_writer import check_not_partial
from splatctrl_cli.recording.container.log_formats import (
    CONTAINERS,
    SUFFIXES,
    SessionLog,
    is_bag_folder,
    open_raw_log,
    refuse_foreign,
)
from splatctrl_cli.recording.container.raw_log import RawLog
from splatctrl_cli.recording.describe_file import describe_file
from splatctrl_cli.recording.folder.image_folder import (
    ImageFolderSource,
    has_views,
    layout_of,
    open_image_folder,
    open_layout,
    unknown_folder,
)
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, TRANSFORMS
from splatctrl_cli.recording.log.rig import camera_topics, missing
from splatctrl_cli.recording.log.ros_log import RosLogSource
from splatctrl_cli.recording.log.state_messages import STATE_TYPES
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.log.survey import NAME as ROBOT
from splatctrl_cli.recording.log.survey import TopicSurvey, robot_descriptions, survey_to_describe
from splatctrl_cli.recording.log.video import SUFFIXES as VIDEOS
from splatctrl_cli.recording.log.video import open_log
from splatctrl_cli.recording.source_options import CameraTopics, SourceOptions

__all__ = ["CameraTopics", "SourceOptions", "open_logs", "open_session", "open_source"]


def open_source(path: Path, options: SourceOptions | None = None, *, needs_depth: bool = True) -> FrameSource:
    """Open an MCAP, ROS bag, capture, dataset or image folder's TOML as records.

    Raises InputError if missing, unusable, or without required depth.
    """
    options = options or SourceOptions()
    refuse_if(not path.exists(), f"{path}: no such file or folder", remedy="check the path")
    if path.suffix == ".toml":
        source: FrameSource = open_image_folder(path, options)
    elif is_capture(path):
        source = CaptureSource(path, options)
    else:
        source = open_layout(path, options) if has_views(path) else RosLogSource(open_log(path), options)
    if needs_depth and source.depth_fault is not None:
        raise source.depth_fault
    return calibrated(source, options)


def open_session(paths: Sequence[Path], options: SourceOptions | None = None) -> FrameSource:
    """Open one input, or several logs recorded at the same time.

    Raises InputError as `open_source`, and if one of several is no log.
    """
    log = open_logs(paths)
    options = options or SourceOptions()
    return open_source(paths[0], options) if log is None else calibrated(RosLogSource(log, options), options)


def logged_descriptions(paths: Sequence[Path]) -> list[tuple[Path, str, str]]:
    """Triples (path, topic or node, text) of logs' and captures' URDFs, each once."""
    by_text: dict[str, tuple[Path, str, str]] = {}
    for path in paths:
        descriptions = []
        if is_capture(path):
            descriptions = read_robot_description(path)
        elif path.exists() and not has_views(path):
            with suppress(InputError):  # a later reader gives the reason
                descriptions = robot_descriptions(open_raw_log(path))
        for where, text in descriptions:
            by_text.setdefault(text, (path, where, text))
    return list(by_text.values())


def open_logs(paths: Sequence[Path]) -> RawLog | None:
    """Open a log, or several of one session; None for another kind.

    Raises InputError if missing, or if one of several is no log.
    """
    for path in paths:
        refuse_if(not path.exists(), f"{path}: no such file or folder", remedy="check the path")
        if path.suffix == ".toml" or is_capture(path) or has_views(path):
            if len(paths) == 1:
                return None
            raise InputError(f"{path}: expected a log, as several were given", remedy="give it alone")
    logs = tuple(open_log(path) for path in paths)
    return logs[0] if len(logs) == 1 else SessionLog(logs)


def describe(path: Path, options: SourceOptions | None = None) -> Summary:
    """Describe any input. Raises InputError if missing or unknown."""
    options = options or SourceOptions()
    refuse_if(not path.exists(), f"{path}: no such file or folder", remedy="check the path")
    if path.is_dir():
        return _describe_folder(path, options)
    with path.open("rb") as stream:
        start = stream.read(16)
    if start.startswith(tuple(magic for magic, _ in CONTAINERS.values())) or path.suffix in (*SUFFIXES, *VIDEOS):
        return describe_log(open_log(path), options)
    if path.suffix == ".toml" and is_calibration(path):
        return describe_calibration(path)
    if path.suffix == ".toml":
        return _describe_images(path, open_image_folder(path, options), "image folder")
    if (layout := layout_of(path)) is not None:
        return _describe_images(path, open_layout(path, options), layout.name)
    try:
        return describe_file(path)
    except InputError:
        refuse_foreign(path)
        raise


def describe_log(log: RawLog, options: SourceOptions) -> Summary:
    """Describe topics, times, frames, cameras, and what a reconstruction lacks."""
    survey, sampling = survey_to_describe(log)
    logged = [t for t in survey.topics.values() if t.count]
    first, last = min((t.first_log_ns for t in logged), default=0), max((t.last_log_ns for t in logged), default=0)
    times = {"start_s": first * 1e-9, "end_s": last * 1e-9, "duration_s": (last - first) * 1e-9}
    frames = {"tf_frames": list(survey.tf.frames), "tf_roots": list(survey.tf.roots)}
    joints = next((t.joints.first_names for t in survey.topics.values() if t.joints.first_names is not None), ())
    robots = [name for name, t in sorted(survey.topics.items()) if t.count and name.endswith(f"/{ROBOT}")]
    facts: dict[str, object] = {
        "bytes": sum(file.stat().st_size for file in log.files),
        "messages": survey.num_messages,
        **(times if logged else {}),
        **(frames if survey.tf.frames else {}),
        **({"joints": list(joints)} if joints else {}),
        **({ROBOT: robots} if robots else {}),
    }
    rows = [_topic_row(survey.topics[name]) for name in sorted(survey.topics)]
    grids = [
        Grid(
            name="topics",
            header=("topic", "type", "encoding", "count", "hz", "first message"),
            rows=rows,
            unused=[name for name, topic in survey.topics.items() if _first(topic) == "-" and not _is_read(topic)],
        )
    ]
    cameras = camera_topics(log, survey, options)
    if cameras:
        rows = [[c.name, c.color, c.depth, c.info or "-"] for c in cameras]
        grids.append(Grid(name="cameras", header=("camera", "color", "depth", "camera_info"), rows=rows))
    lacks = missing(log, survey, options) if survey.num_messages else ["the log holds no messages"]
    return Summary(
        path=str(log.path),
        kind=log.container,
        facts=facts,
        grids=tuple(grids),
        missing=tuple(lacks),
        notes=(*sampling, *survey.damage.all_notes, *survey.tf.notes),
        damaged=survey.damage.count,
    )


def _topic_row(entry: TopicSurvey) -> list[object]:
    span = (entry.last_log_ns - entry.first_log_ns) * 1e-9
    return [
        entry.topic.name,
        entry.topic.schema or entry.topic.type_name or "-",
        entry.topic.encoding or "-",
        entry.count,
        f"{(entry.count - 1) / span:.2f}" if entry.count > 1 and span > 0 else "-",
        _first(entry),
    ]


def _is_read(entry: TopicSurvey) -> bool:
    name, kind = entry.topic.name, entry.topic.type_name or ""
    types = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, *STATE_TYPES, *TRANSFORMS)
    return kind in types or kind.startswith("geometry_msgs/") or name.endswith(f"/{ROBOT}")


def _first(entry: TopicSurvey) -> str:
    image, calibration = entry.first_image, entry.calibration
    if image is not None:
        wrapped = " compressed" if image.compressed is not None else ""
        return f"{image.width}x{image.height} {image.encoding}{wrapped} in frame {image.frame_id!r}"
    if calibration is not None:
        K = calibration.K
        return f"{calibration.width}x{calibration.height} fx {K[0, 0]:.1f} cx {K[0, 2]:.1f} cy {K[1, 2]:.1f}"
    return f"{len(entry.joints.first_names)} joints" if entry.joints.first_names is not None else "-"


def _describe_folder(path: Path, options: SourceOptions) -> Summary:
    if is_capture(path):
        return _describe_capture(path)
    check_not_partial(path)
    if is_bag_folder(path):
        return describe_log(open_log(path), options)
    if (layout := layout_of(path)) is not None:
        return _describe_images(path, open_layout(path, options), layout.name)
    names = {name for name in ("run.json", "splats.ply", "occupancy.npz", "field.json") if (path / name).is_file()}
    is_dtu = all((path / name).is_dir() for name in ("Cameras", "Rectified"))
    if not ("run.json" in names or "splats.ply" in names or is_dtu):
        refuse_foreign(path)
        raise unknown_folder(
            path,
            "a folder of no known kind",
            "expected a capture, ROS 2 bag, dataset folder (splatctrl help formats), MVSNet scan or output;"
            " for other images give their .toml",
        )
    field = _field_facts(path / "field.json") if "field.json" in names else {}
    kind = "MVSNet scan" if is_dtu else "scene folder" if "splats.ply" in names else "run folder"
    kind = "field folder" if field else kind
    entries = [path / name for name in names_in(path)[:1000]]
    rows = [[file.name + "/" if file.is_dir() else file.name, *files_below(file)] for file in entries]
    count, size = files_below(path)
    is_read = "run.json" in names and (not field or "occupancy.npz" in names)
    run = describe_file(path / "run.json").facts if is_read else {}
    facts: dict[str, object] = {
        "files": count,
        "bytes": size,
        **({"splats": describe_file(path / "splats.ply").facts} if "splats.ply" in names else {}),
        **({"space": _known_space(path, run)} if "occupancy.npz" in names else {}),
        **(
            field
            or ({"run": {key: value for key, value in run.items() if key != "config"}} if "run.json" in names else {})
        ),
    }
    grid = Grid(name="files", header=("name", "files", "bytes"), rows=rows)
    return Summary(path=str(path), kind=kind, facts=facts, grids=(grid,))


def _known_space(path: Path, run: Mapping[str, Any]) -> dict[str, object]:
    thresholds, where = OccupancyConfig(), str(path / "run.json")
    used: dict[str, Any] = {
        name: run_value(run, ("config", "occupancy", name), _probability, getattr(thresholds, name), where=where)
        for name in ("free_below", "occupied_above")
    }
    return known_space(read_occupancy(path / "occupancy.npz"), replace(thresholds, **used))


def _probability(value: Any) -> float:
    number = float(value)
    refuse_if(not 0.0 < number < 1.0, f"{number}, expected a probability between 0 and 1", error=ValueError)
    return number


def _field_facts(path: Path) -> dict[str, object]:
    header: Mapping[str, Any] = describe_file(path).facts
    if header.get("format") != FORMAT or not {"shape", "first_cell", "voxel"} <= header.keys():
        return {}
    return {**covers(header["first_cell"], header["voxel"], header["shape"]), **header_facts(header)}


def _describe_capture(path: Path) -> Summary:
    header = read_capture_header(path)
    rows = [
        [name, camera["num_frames"], f"{camera['width']}x{camera['height']}", camera["fx"], camera["depth_scale"]]
        for name, camera in header["cameras"].items()
    ]
    loss: dict[str, Any] = header["loss"]
    facts: dict[str, object] = {
        "recorded_from": header["name"],
        "world_frame": header["world_frame"],
        "has_clock": header["has_clock"],
        "joints": header["joint_names"],
        "loss": {key: value for key, value in loss.items() if key != "notes"},
        "sources": len(header["sources"]),
    }
    grid = Grid(name="cameras", header=("camera", "frames", "size", "fx", "depth_scale"), rows=rows)
    return Summary(path=str(path), kind="capture", facts=facts, grids=(grid,), notes=tuple(loss.get("notes", ())))


def _describe_images(path: Path, source: ImageFolderSource, kind: str) -> Summary:
    first = next((item for item in source.stored() if isinstance(item, StoredFrame)), None)
    counts = {name: sum(camera == name for _, camera, _ in source.poses()) for name in source.cameras}
    loss, k = source.loss, None if first is None else first.intrinsics
    facts: dict[str, object] = {
        "has_clock": source.has_clock,
        **({} if k is None else {"size": f"{k.width}x{k.height}", "fx_fy_cx_cy": [k.fx, k.fy, k.cx, k.cy]}),
        **({} if first is None else {"first_valid_depth_share": round(float((first.depth > 0).mean()), 4)}),
        "loss": {name: getattr(loss, name) for name in ("unpaired_color", "unpaired_depth", "without_pose")},
    }
    grid = Grid(name="cameras", header=("camera", "frames"), rows=[list(item) for item in counts.items()])
    fault = "" if source.depth_fault is None else str(source.depth_fault)
    return Summary(
        path=str(path),
        kind=kind,
        facts=facts,
        grids=(grid,),
        missing=(fault[fault.index("depth is missing") :],) if fault else (),
        notes=tuple(loss.notes),
    )
