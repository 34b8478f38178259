"""A writer of capture folders (docs/capture.md), in bounded memory. A journal lets a killed run continue."""

import hashlib
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.lib import format as npy

from splatctrl_cli.config.fixed import FLOAT_DEPTH_ERROR, FLOAT_DEPTH_UNIT
from splatctrl_cli.errors import UsageError, WriteError, refuse_if
from splatctrl_cli.files.output import sha256, write_json, write_table
from splatctrl_cli.formats.image_file import PNG
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.recording.capture.capture import COLUMNS, FORMAT, MASKS, ROBOT, SUMS, VERSION
from splatctrl_cli.recording.log.messages import metres
from splatctrl_cli.recording.log.state_columns import StateCollector, StateColumns
from splatctrl_cli.recording.log.stored_frame import (
    FOLDER,
    FrameSource,
    JointTopics,
    StoredFrame,
    is_kept,
    npy_bytes,
    write_rows,
    write_topics,
)
from splatctrl_cli.records import Float32, JointState

JOURNAL = "ingest.jsonl"  # in the folder while it is partial


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A written frame: frames.csv row, (sha256, name) of files, provenance.csv row."""

    row: Mapping[str, str]
    sums: Sequence[tuple[str, str]]
    provenance: Mapping[str, str]


class Journal:
    """A partial folder's journal: an earlier run's entries, then new ones."""

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        """identity: facts that decide the bytes, compared when a run resumes."""
        self.path = folder / JOURNAL
        self.num_entries = 0
        folder.mkdir(parents=True, exist_ok=True)
        if not self.path.is_file():
            self.path.write_text(json.dumps({"identity": identity}) + "\n", encoding="utf-8")
        with self.path.open("r+b") as stream:  # a killed run may leave half a line
            stream.truncate(sum(len(line) for line in stream if line.endswith(b"\n")))
        self._earlier = self.entries()

    def next_kept(self) -> Entry | None:
        entry = next(self._earlier, None)
        self.num_entries += entry is not None
        return entry

    def add(self, entry: Entry) -> None:
        self.num_entries += 1
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(vars(entry)) + "\n")

    def entries(self) -> Iterator[Entry]:
        return (Entry(**line) for line in islice(_lines(self.path), 1, None))


def read_identity(folder: Path) -> Mapping[str, Any] | None:
    path = folder / JOURNAL
    first = next(_lines(path), None) if path.is_file() else None
    return None if first is None else first.get("identity")


def check_not_partial(folder: Path) -> None:
    """Raise InputError for an interrupted capture."""
    refuse_if(
        (folder / JOURNAL).is_file(),
        f"{folder}: an ingest that was interrupted",
        remedy="continue it with the same command and --resume",
    )


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    with path.open(encoding="utf-8") as stream:
        yield from (json.loads(line) for line in stream if line.endswith("\n"))


LENSES = "valid/"  # masks that all frames of a lens share, out of order
PROVENANCE = "provenance.csv"
PLACE = ("file", "offset", "log_time_ns")
PROVENANCE_COLUMNS = ("color", "depth", *(f"{kind}_{name}" for kind in ("color", "depth") for name in PLACE))
_FILTERED = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]  # docs/benchmarks.md


def write_capture(
    folder: Path,
    source: FrameSource,
    *,
    topics: JointTopics | None = None,
    robot: str = "",
    progress: Callable[[int], None] | None = None,
    identity: Mapping[str, Any] | None = None,
) -> tuple[dict[str, Any], int]:
    """Write all of `source` into `folder`, empty or of an interrupted run.

    JPEG or PNG colour with exactly the frame's pixels is kept byte for byte. Depth becomes 16-bit PNG in its recorded
    unit, or .npy [m] if counts would not restore it. topics: all joint states as recorded; `source` has those of one
    topic. robot: the log's URDF, or "". Returns frames by camera, joint_states and loss, as in run.json, and the
    number of earlier frames. Raises InputError without a frame, UsageError if earlier frames differ.
    """
    states = StateCollector(len(source.joint_names))
    cameras: dict[str, dict[str, Any]] = {}
    num_resumed = 0
    journal = Journal(folder, identity or {})
    for item in source.stored():
        if isinstance(item, JointState):
            states.add(item)
            continue
        row, entry = _row(item, cameras), journal.next_kept()
        if entry is None:
            journal.add(_write_frame(folder, item, row, cameras[item.camera]))
        else:
            name = next((name for name in row if entry.row.get(name) != row[name]), "")
            refuse_if(
                name,
                f"{folder}: --resume: {entry.row.get('color')}: {name} was {entry.row.get(name)}, is {row.get(name)}",
                remedy="the source has changed; start over without --resume",
                error=UsageError,
            )
            num_resumed += 1
        if progress is not None:
            progress(journal.num_entries)
    refuse_if(not journal.num_entries, f"{source.name}: no frame could be read", remedy="see `splatctrl info`")
    header = {
        "format": FORMAT,
        "version": VERSION,
        "name": source.name,
        "world_frame": source.world_frame,
        "tf_frames": {name: None if T is None else T.tolist() for name, T in source.tf_frames.items()},
        "units": {"length": "m", "time": "ns", "angle": "rad"},
        "pose": "T_world_camera, optical frame (x right, y down, z forward), quaternion x y z w",
        "pixels": "pixel (0, 0) is centred at u = v = 0",
        "has_clock": source.has_clock,
        "cameras": cameras,
        "joint_names": list(source.joint_names),
        "sources": source.digests(),
        "loss": asdict(source.loss),
    }
    logged = states.columns()
    _write_joints(folder / "joints.npz", logged)
    _write_index(folder, header, journal, topics, robot)
    journal.path.unlink()
    frames = {name: camera["num_frames"] for name, camera in cameras.items()}
    return {"frames": frames, "joint_states": len(logged), "loss": header["loss"]}, num_resumed


def _write_index(
    folder: Path, header: dict[str, Any], journal: Journal, topics: JointTopics | None, robot: str
) -> None:
    names = ["joints.npz", "frames.csv"]
    if robot:
        (folder / ROBOT).write_text(robot, encoding="utf-8", newline="")
        names.append(ROBOT)
    columns = (*COLUMNS, *(name for name in MASKS if any(name in entry.row for entry in journal.entries())))
    write_table(folder / "frames.csv", columns, (entry.row for entry in journal.entries()))
    if any(entry.provenance for entry in journal.entries()):
        names.append(PROVENANCE)
        write_table(folder / PROVENANCE, PROVENANCE_COLUMNS, (entry.provenance for entry in journal.entries()))
    if topics is not None and topics.topics:
        shutil.rmtree(folder / FOLDER, ignore_errors=True)  # what an interrupted run left
        header = header | {"joint_topics": write_topics(folder, topics, names.append)}
    write_json(folder / "capture.json", header)
    of_lenses = {
        name: digest for entry in journal.entries() for digest, name in entry.sums if name.startswith(LENSES)
    }
    _write_sums(
        folder / SUMS, journal, of_lenses | {name: sha256(folder / name) for name in [*names, "capture.json"]}
    )


def _write_sums(path: Path, journal: Journal, others: Mapping[str, str]) -> None:
    written = (name for entry in journal.entries() for _, name in entry.sums if not name.startswith(LENSES))
    folders = {f"{name.rpartition('/')[0]}/" for name in written}
    with path.open("w", encoding="utf-8", newline="") as stream:
        for place in sorted([*folders, *others]):
            images = (each for entry in journal.entries() for each in entry.sums)
            its = [(others[place], place)] if place in others else (i for i in images if i[1].startswith(place))
            stream.writelines(f"{digest}  {name}\n" for digest, name in its)


def _row(stored: StoredFrame, cameras: dict[str, dict[str, Any]]) -> dict[str, str]:
    refuse_if(
        stored.camera in {"", ".", ".."} or not {"/", "\0"}.isdisjoint(stored.camera),
        f"{stored.origin}: camera {stored.camera!r}: cannot name a folder",
        remedy="rename the camera",
    )
    intrinsics = vars(stored.intrinsics)
    camera = cameras.setdefault(
        stored.camera,
        {
            **intrinsics,
            "depth_scale": FLOAT_DEPTH_UNIT if stored.depth_unit is None else stored.depth_unit,
            "num_frames": 0,
        },
    )
    refuse_if(
        any(camera[name] != value for name, value in intrinsics.items()),
        f"{stored.origin}: camera {stored.camera} changes its intrinsics; a capture holds one set of each camera",
        remedy="leave --holdout to `reconstruct` and `score`",
    )
    camera["num_frames"] += 1
    T = stored.T_world_camera
    pose = [repr(float(value)) for value in (*T[:3, 3], *quat_from_rotation(T[:3, :3]))]
    return {
        "camera": stored.camera,
        "stamp_ns": str(stored.stamp_ns),
        **dict(zip(COLUMNS[4:11], pose, strict=True)),
        "source": stored.origin,
    }


def _write_frame(folder: Path, stored: StoredFrame, row: dict[str, str], camera: Mapping[str, Any]) -> Entry:
    stem, unit = f"{camera['num_frames'] - 1:06d}", float(camera["depth_scale"])
    color = stored.color_file or encode_png(cv2.cvtColor(stored.color, cv2.COLOR_RGB2BGR))
    color_name = f"color/{stored.camera}/{stem}.{'png' if is_kept(color, PNG) else 'jpg'}"
    kind, depth = _depth_file(stored, unit)
    depth_name = f"depth/{stored.camera}/{stem}.{kind}"
    files = {color_name: color, depth_name: depth}
    named = {"color": color_name, "depth": depth_name}
    if stored.human is not None:
        named["human"] = f"human/{stored.camera}/{stem}.png"
        files[named["human"]] = encode_png(stored.human * np.uint8(255))
    if stored.valid is not None:
        mask = encode_png(stored.valid * np.uint8(255))
        named["valid"] = f"{LENSES}{stored.camera}/{hashlib.sha256(mask).hexdigest()[:16]}.png"
        files[named["valid"]] = mask
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return Entry(
        row=row | named,
        sums=[(hashlib.sha256(data).hexdigest(), name) for name, data in files.items()],
        provenance=_provenance(stored, color_name, depth_name),
    )


def _provenance(stored: StoredFrame, color: str, depth: str) -> dict[str, str]:
    messages = {"color": color, "depth": depth} if stored.places else {}
    for kind, place in zip(("color", "depth"), stored.places, strict=False):
        messages |= {
            f"{kind}_file": place.file,
            f"{kind}_offset": "" if place.offset < 0 else str(place.offset),
            f"{kind}_log_time_ns": str(place.log_time_ns),
        }
    return messages


def _depth_file(stored: StoredFrame, unit: float) -> tuple[str, bytes]:
    if stored.depth_file is not None and stored.depth_unit == unit:
        return "png", stored.depth_file
    counts = _counts(stored.depth, unit, is_exact=stored.depth_unit is not None)
    return ("npy", npy_bytes(stored.depth)) if counts is None else ("png", encode_png(counts))


def _counts(depth: Float32, unit: float, *, is_exact: bool) -> np.ndarray[Any, np.dtype[np.uint16]] | None:
    """uint16 counts of `unit`; None if they would not restore depth."""
    if depth.max(initial=0.0) / unit > 65534.5:
        return None
    counts = np.round(depth / np.float32(unit)).astype(np.uint16)
    error = np.abs(metres(counts, unit) - depth).max(initial=0.0)
    return counts if error <= (0.0 if is_exact else FLOAT_DEPTH_ERROR) else None


def encode_png(pixels: np.ndarray[Any, Any]) -> bytes:
    is_written, data = cv2.imencode(".png", pixels, _FILTERED)
    refuse_if(not is_written, f"an image of shape {pixels.shape} could not be encoded as PNG", error=WriteError)
    return bytes(data)


def _write_joints(path: Path, states: StateColumns) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        with archive.open("stamp_ns.npy", "w", force_zip64=True) as stream:
            npy.write_array(stream, states.stamp_ns, allow_pickle=False)
        for name, rows in states.tables().items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                write_rows(stream, rows)
