"""A capture as one MCAP of standard messages that viewers open, and back, byte for byte.

Messages are of ROS 2 (CDR): /CAM/color/image/compressed with the file's own bytes, /CAM/depth/image (16UC1 mm where
the capture counts millimetres, else 32FC1 m), /CAM/*/camera_info, /tf, /joint_states. The depth file's own bytes are
in /CAM/depth/image/compressedDepth, as image_transport's plugin of that name has them: twelve bytes, then the PNG.
All other files are attachments, by their path.
"""

import csv
import hashlib
import io
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import numpy as np

from splatctrl_cli.captures.capture import CaptureSource
from splatctrl_cli.captures.capture_header import SUMS, VERSION
from splatctrl_cli.containers.log_formats import open_raw_log
from splatctrl_cli.containers.mcap_file import McapFile
from splatctrl_cli.containers.mcap_records import ATTACHMENT, BadRecordError, Metadata, parse_record
from splatctrl_cli.containers.raw_log import Damage
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.image_file import PNG
from splatctrl_cli.files.unpacking import PIECE
from splatctrl_cli.logs.decoder import MessageDecoder, UndecodableMessageError
from splatctrl_cli.logs.mcap_writer import McapLog, mcap_log
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.logs.stored_frame import AGAIN, StoredFrame
from splatctrl_cli.records import MILLIMETRES, JointState, RgbdFrame, by_stamp

MOST_FILES = 1 << 20  # an empty file takes a disk's block, its name in an archive thirty bytes
_LONGEST = 255  # bytes of a name
MARK = "splatctrl-capture"  # name of the metadata record
DEPTH_HEAD = bytes(12)  # of compressed_depth_image_transport: its parameters, which 16UC1 does not use
_TYPES = {".json": "application/json", ".csv": "text/csv", ".npz": "application/zip"}
METADATA = 0x0C
_COPY = "copy the file again"
_IMAGES = ("color", "depth", "human")  # columns of frames.csv


class NewFolder:
    """An empty folder that files are written into. `digests`: sha256 of what was written, by name."""

    def __init__(self, path: Path) -> None:
        self.digests: dict[str, str] = {}
        self._path = path
        self._taken: set[str] = set()
        self._folders: set[str] = set()

    def write(self, name: str, pieces: Iterable[bytes]) -> None:
        """Write a file.

        Raises InputError for a name that leads elsewhere, that a file system may not hold or not tell from another
        (case), or that is taken.
        """
        parts = PurePosixPath(name).parts
        is_odd = not name.isprintable() or any(len(part.encode(errors="replace")) > _LONGEST for part in parts)
        if not parts or name.startswith("/") or ".." in parts or "\\" in name or is_odd:
            raise InputError(
                f"{name[:_LONGEST]!r}: not the name of a file of a capture", remedy="do not trust this file"
            )
        self._take(parts)
        path = self._path.joinpath(*parts)
        path.parent.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256()
        with path.open("xb") as stream:
            for piece in pieces:
                digest.update(piece)
                stream.write(piece)
        self.digests["/".join(parts)] = digest.hexdigest()

    def _take(self, parts: tuple[str, ...]) -> None:
        names = ["/".join(parts[: i + 1]).casefold() for i in range(len(parts))]
        if names[-1] in self._taken or names[-1] in self._folders or not self._taken.isdisjoint(names[:-1]):
            raise InputError(f"{'/'.join(parts)!r}: two files of that name", remedy="do not trust this file")
        if len(self._taken) >= MOST_FILES:
            raise InputError(f"over {MOST_FILES} files, expected fewer", remedy="do not trust this file")
        self._taken.add(names[-1])
        self._folders.update(names[:-1])


def pack_capture(capture: Path, out: Path, progress: Callable[[int], None] | None = None) -> int:
    """Write `capture` as the MCAP `out`; returns the number of frames. Raises InputError where a file is damaged."""
    source = CaptureSource(capture, SourceOptions())
    with mcap_log(out) as log:
        log.describe(MARK, {"version": str(VERSION), "name": capture.name})
        records: Iterator[JointState | StoredFrame] = by_stamp(source.states, _stored_frames(source, capture))
        num_frames = 0
        for record in records:
            if isinstance(record, JointState):
                log.add_joint_state(record, source.joint_names)
                continue
            row = source.row(num_frames)
            files = {name: capture / row[name] for name in _IMAGES if row.get(name)}
            _add_frame(log, record.frame, record.depth_unit, files, source)
            num_frames += 1
            if progress is not None:
                progress(num_frames)
        images = {row[name] for row in map(source.row, range(len(source))) for name in _IMAGES if row.get(name)}
        for name in sorted(p.relative_to(capture).as_posix() for p in capture.rglob("*") if p.is_file()):
            if name not in images:
                if not Path(os.path.realpath(capture / name)).is_relative_to(os.path.realpath(capture)):
                    raise InputError(f"{capture / name}: leads out of the capture", remedy="remove the link")
                media_type = _TYPES.get(PurePosixPath(name).suffix, "application/octet-stream")
                log.attach(name, media_type, (capture / name).read_bytes())
    return len(source)


def unpack_capture(packed: Path, folder: Path) -> int:
    """Write the capture that `packed` holds into the empty `folder`; returns the number of frames.

    Raises InputError where it holds none, where it is damaged, where a name in it is not that of one file below a
    folder, and where a file is not what SHA256SUMS of the capture says.
    """
    damage, names, attachments = Damage(), set[str](), []
    for part in McapFile(packed).parts(damage):
        if part.opcode == METADATA:
            names.add(_metadata_name(part.content))
        elif part.opcode == ATTACHMENT:
            attachments.append(part.offset)
    _check_whole(packed, damage)
    if MARK not in names:
        raise InputError(f"{packed}: not a packed capture", remedy="for other logs use `splatctrl ingest`")
    target = NewFolder(folder)
    with packed.open("rb") as stream:
        for offset in attachments:
            target.write(*attachment_at(stream, offset))
    num_frames = _unpack_images(folder, packed, target)
    _check_sums(packed, folder, target.digests)
    return num_frames


def _stored_frames(source: CaptureSource, capture: Path) -> Iterator[StoredFrame]:
    """All of them, by their rows."""
    for number in range(len(source)):
        stored = source.stored_at(number)
        if stored is None:
            raise InputError(f"{capture}: {source.loss.notes[-1]}", remedy=AGAIN)
        yield stored


def _add_frame(
    log: McapLog, frame: RgbdFrame, unit: float | None, files: Mapping[str, Path], source: CaptureSource
) -> None:
    """All messages of a frame; files by column."""
    stamp, camera = frame.stamp_ns, frame.camera
    if stamp < 0:
        raise InputError(f"{source.name}: stamp {stamp} ns: MCAP has no times before 0", remedy="shift the stamps")
    frame_id = f"{camera}_optical_frame"
    log.add_transforms(stamp, [(source.world_frame, frame_id, frame.T_world_camera)], is_static=False)
    for kind in ("color", "depth"):
        log.add_camera_info(f"/{camera}/{kind}/camera_info", stamp, frame_id, frame.intrinsics)
    color = files["color"].read_bytes()
    form = "png" if color.startswith(PNG) else "jpeg"
    log.add_image_file(f"/{camera}/color/image/compressed", stamp, frame_id, form, color)
    if unit == 1.0 / MILLIMETRES:
        pixels: Any = np.rint(frame.depth.astype(np.float64) * MILLIMETRES).astype("<u2")
        log.add_image(f"/{camera}/depth/image", stamp, frame_id, "16UC1", pixels)
    else:
        log.add_image(f"/{camera}/depth/image", stamp, frame_id, "32FC1", frame.depth.astype("<f4"))
    depth, is_png = files["depth"].read_bytes(), files["depth"].suffix == ".png"
    topic = f"/{camera}/depth/image/compressedDepth" if is_png else f"/{camera}/depth/file"
    data = DEPTH_HEAD + depth if is_png else depth
    log.add_image_file(topic, stamp, frame_id, "16UC1; compressedDepth png" if is_png else "npy", data)
    if "human" in files:
        log.add_image_file(f"/{camera}/people/mask/compressed", stamp, frame_id, "png", files["human"].read_bytes())


def _unpack_images(folder: Path, packed: Path, target: NewFolder) -> int:
    """Write the images under the names that frames.csv gives them, in its order."""
    rows = _rows(packed, folder / "frames.csv")
    names: dict[str, Iterator[str]] = {}
    for camera in {row["camera"] for row in rows}:
        of_camera = [row for row in rows if row["camera"] == camera]
        depth = [row["depth"] for row in of_camera]
        names[f"/{camera}/color/image/compressed"] = iter([row["color"] for row in of_camera])
        names[f"/{camera}/depth/image/compressedDepth"] = iter([name for name in depth if name.endswith(".png")])
        names[f"/{camera}/depth/file"] = iter([name for name in depth if not name.endswith(".png")])
        masks = [row["human"] for row in of_camera if row.get("human")]
        names[f"/{camera}/people/mask/compressed"] = iter(masks)
    damage, decoder = Damage(), MessageDecoder()
    for message in open_raw_log(packed).messages(damage, set(names)):
        topic = message.topic.name
        try:
            data = bytes(decoder.decode(message).data)
        except (UndecodableMessageError, AttributeError, TypeError, ValueError) as error:
            raise InputError(f"{packed}: cannot be unpacked: {error}", remedy=_COPY) from None
        name = next(names[topic], None)
        if name is None:
            raise InputError(f"{packed}: {topic} has more images than frames.csv has rows", remedy=_COPY)
        target.write(name, [data[len(DEPTH_HEAD) :] if topic.endswith("/compressedDepth") else data])
    _check_whole(packed, damage)
    return len(rows)


def _metadata_name(content: bytes) -> str:
    try:
        record = parse_record(METADATA, content)
    except BadRecordError:
        return ""
    return record.name if isinstance(record, Metadata) else ""


def _rows(packed: Path, file: Path) -> list[dict[str, str]]:
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
    except (FileNotFoundError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{packed}: its frames.csv cannot be read: {error}", remedy=_COPY) from None
    if any(row.get(name) is None for row in rows for name in ("camera", "color", "depth")):
        raise InputError(f"{packed}: its frames.csv lacks a camera or an image", remedy=_COPY)
    return rows


def _check_whole(packed: Path, damage: Damage) -> None:
    if damage.count:
        raise InputError(f"{packed}: cannot be unpacked: {damage.notes[0]}", remedy=_COPY)


def _check_sums(packed: Path, folder: Path, written: Mapping[str, str]) -> None:
    """Raise InputError where a file that SHA256SUMS names is missing or another."""
    file = folder / SUMS
    if not file.is_file():
        raise InputError(f"{packed}: {SUMS} is missing", remedy=_COPY)
    for line in io.StringIO(file.read_text(encoding="utf-8", errors="replace")):
        digest, name = line[:64], line[66:].rstrip("\n")
        if written.get(name) != digest:
            what = "is missing" if name not in written else "differs from what was packed"
            raise InputError(f"{packed}: {name} {what}", remedy=_COPY)


def attachment_at(stream: BinaryIO, offset: int) -> tuple[str, Iterator[bytes]]:
    """Name and content of the attachment whose record begins at `offset`, of a file whose records are whole."""
    stream.seek(offset + 9 + 16)  # behind opcode, length and two times
    name = stream.read(_u32(stream)).decode("utf-8", "replace")
    stream.seek(_u32(stream), 1)  # the media type
    return name, _pieces(stream, int.from_bytes(stream.read(8), "little"))


def _u32(stream: BinaryIO) -> int:
    return int.from_bytes(stream.read(4), "little")


def _pieces(stream: BinaryIO, size: int) -> Iterator[bytes]:
    while size > 0 and (piece := stream.read(min(size, PIECE))):
        size -= len(piece)
        yield piece
