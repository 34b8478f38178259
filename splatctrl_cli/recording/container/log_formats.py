"""Recorded logs opened by content: files, ROS 2 bag folders, logs of one session.

Files or messages may be compressed with zstd.
"""

import heapq
import re
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import yaml
import zstandard

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.files.summary import names_in
from splatctrl_cli.formats.unpacking import (
    FREE_BYTES,
    MAX_BLOCK,
    MAX_WINDOW,
    PIECE,
    BadBlockError,
    Budget,
    unpacked_start,
)
from splatctrl_cli.recording.container.bag_logs import Bag1Log, Db3Log
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage, JoinedLog, RawLog, RawMessage

_MOST_RATIO = 100  # of an unpacked file, on disk, to the compressed one


def unpack(path: Path, target: Path) -> str:
    """Unpack a .zstd as far as possible; return the fault, or ""."""
    left = FREE_BYTES + _MOST_RATIO * path.stat().st_size
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    with path.open("rb") as source, target.open("wb") as written:
        stream = decompressor.stream_reader(source, read_across_frames=True)
        while True:
            try:
                piece = stream.read(PIECE)
            except zstandard.ZstdError:
                return "cannot be decompressed further"
            if not piece:
                return ""
            left -= len(piece)
            if left < 0:
                return f"unpacks to over {_MOST_RATIO} times its size"
            written.write(piece)


def unpack_messages(messages: Iterable[RawMessage], damage: Damage, log_bytes: int) -> Iterator[RawMessage]:
    """Yield unpacked zstd messages of a log of `log_bytes`; failures are counted."""
    budget = Budget(log_bytes)
    for message in messages:
        try:
            with refuse_faults(lambda _: "is not a zstd frame", zstandard.ZstdError, error=BadBlockError):
                size = zstandard.frame_content_size(message.data)
            size = size if size >= 0 else len(unpacked_start(message.data, "zstd", MAX_BLOCK))
            yield replace(message, data=budget.unpacked(message.data, "zstd", size))
        except BadBlockError as error:
            damage.add(f"{message.topic.name}: a message was left out: {error}")


_ZSTD = b"\x28\xb5\x2f\xfd"


CONTAINERS: Mapping[str, tuple[bytes, Callable[[Path], RawLog]]] = {  # first bytes and opener by suffix
    ".mcap": (b"\x89MCAP0\r\n", McapLog),
    ".bag": (b"#ROSBAG V", Bag1Log),
    ".db3": (b"SQLite format 3", Db3Log),
}
SUFFIXES = tuple(CONTAINERS)


class SessionLog(JoinedLog):
    """Logs recorded at the same time, merged by log time."""

    def __init__(self, parts: tuple[RawLog, ...]) -> None:
        super().__init__(
            parts[0].path.with_name("+".join(part.path.name for part in parts)),
            parts,
            " + ".join(dict.fromkeys(part.container for part in parts)),
        )

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield all parts' messages by log time.

        If parts share a topic, all topics are read, so that `names` do not change the order.
        """
        pushed = None if names is None or self._share(names) else names
        messages = (part.messages(damage, pushed) for part in self._parts)
        merged = heapq.merge(*messages, key=lambda message: message.log_time_ns)
        yield from (message for message in merged if names is None or message.topic.name in names)

    def _share(self, names: Collection[str]) -> bool:
        seen: set[str] = set()
        for part in self._parts:
            topic_names = {topic.name for topic in part.topics()}
            if not topic_names or seen & topic_names & set(names):  # a log without index may hold anything
                return True
            seen |= topic_names
        return False


def open_raw_log(path: Path) -> RawLog:
    """Open .mcap, .bag, .db3 or a ROS 2 bag folder, with zstd messages unpacked.

    Raises InputError for other or unreadable files.
    """
    if path.is_dir():
        return _open_folder(path)
    refuse_if(path.stat().st_size == 0, f"{path}: the file is empty (0 bytes)", remedy="record or copy it again")
    with path.open("rb") as stream:
        magic = stream.read(16)
    open_kind = next((opener for first, opener in CONTAINERS.values() if magic.startswith(first)), None)
    if open_kind is not None:
        log = open_kind(path)
        first = () if isinstance(log, Bag1Log) else islice(log.messages(Damage()), 5)  # some may be damaged
        is_packed = any(m.topic.encoding == "cdr" and m.data.startswith(_ZSTD) for m in first)  # CDR begins with a 0
        unpack_all = partial(unpack_messages, log_bytes=sum(file.stat().st_size for file in log.files))
        return JoinedLog(path, (log,), log.container, change=unpack_all) if is_packed else log
    if magic.startswith(_ZSTD):
        return _open_compressed(path)
    refuse_if(
        path.suffix in SUFFIXES,
        f"{path}: does not begin like a {path.suffix} file (first bytes {magic[:8]!r})",
        remedy="the file is damaged or has the wrong name",
    )
    raise InputError(
        f"{path}: unknown kind of file", remedy="expected .mcap, .bag, .db3, a bag folder, X.capture/ or a .toml"
    )


def is_bag_folder(path: Path) -> bool:
    return bool(_storage_files(path)) or (path / "metadata.yaml").is_file()


def _open_folder(path: Path) -> RawLog:
    metadata, note = _metadata(path)
    names = metadata.get("relative_file_paths")  # in recording order; else by numbers in names
    files = [path / Path(name).name for name in dict.fromkeys(names or ())] or sorted(
        _storage_files(path), key=lambda p: [int(n) for n in re.findall(r"\d+", p.name)]
    )
    missing = [file.name for file in files if not file.is_file()]
    refuse_if(
        missing,
        f"{path}: metadata.yaml names {''.join(missing[:1])}, which is not there",
        remedy="copy the whole bag",
    )
    refuse_if(not files, f"{path}: a bag folder without .mcap or .db3 files", remedy="copy the whole bag")
    mode, compression = str(metadata.get("compression_mode", "")).lower(), str(metadata.get("compression_format"))
    refuse_if(
        mode and compression != "zstd",
        f"{path}: compression {compression!r} is unknown, expected zstd",
        remedy="rewrite the bag with zstd",
    )
    parts = tuple(open_raw_log(file) for file in files)
    kind = "mcap" if ".mcap" in files[0].suffixes else "sqlite3"
    return JoinedLog(path, parts, f"ROS 2 bag ({kind}, {len(parts)} file{'s' if len(parts) > 1 else ''})", note=note)


def read_formats(path: Path) -> set[str]:
    """Serialization formats in a bag folder's metadata.yaml."""
    with suppress(KeyError, TypeError):
        topics = _metadata(path)[0].get("topics_with_message_count") or ()
        return {str(topic["topic_metadata"]["serialization_format"]) for topic in topics}
    return set()


def _open_compressed(path: Path) -> RawLog:
    folder = Path(tempfile.mkdtemp(prefix="splatctrl-"))
    file = folder / path.stem
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        note = unpack(path, file)
        with file.open("rb") as stream:
            start = stream.read(4)
        refuse_if(not start, f"{path}: {note or 'holds nothing'}", remedy="copy it again")
        refuse_if(start == _ZSTD, f"{path}: compressed twice", remedy="unpack it with zstd -d")
        try:
            part = open_raw_log(file)
        except InputError as error:
            message = error.message.removeprefix(f"{file}: ")
            raise InputError(f"{path}: {message}", remedy=error.remedy) from None
        log = JoinedLog(path, (part,), part.container, files=(path,), note=f"{path.name}: {note}" if note else "")
        weakref.finalize(log, stack.pop_all().close)
    return log


def _storage_files(path: Path) -> list[Path]:
    return [path / name for name in names_in(path) if name.endswith((".mcap", ".db3", ".mcap.zstd", ".db3.zstd"))]


def _metadata(path: Path) -> tuple[dict[str, Any], str]:
    file = path / "metadata.yaml"
    if not file.is_file():
        return {}, ""
    try:
        metadata = dict(yaml.safe_load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"])
        refuse_if(
            not all(isinstance(name, str) for name in metadata.get("relative_file_paths") or ()),
            "a file's name is not text",
            error=ValueError,
        )
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):  # an undecodable text is a ValueError
        return {}, f"{file.name}: is not the metadata of a ROS 2 bag; read without it, files by their numbers"
    return metadata, ""


_BAG = "and record its image, camera_info and tf topics with `ros2 bag record`"
_FOLDER = "write colour and 16-bit PNG depth with poses as an image folder (splatctrl help input)"
_TABLE = f"describe joint states in it in a .toml (splatctrl help replay, Logs); of images {_FOLDER}"
AZURE_KINECT = f"play it with azure_kinect_ros_driver (recording_file:=FILE) {_BAG}, depth from /depth_to_rgb"
_ENDS = 1 << 20  # bytes at either end of a file that are searched for its marks


@dataclass(frozen=True, kw_only=True)
class Foreign:
    """An unsupported format: what it is, the remedy, and its marks.

    Marks: a suffix, first bytes with a mark near either end, or an entry of a zip file or folder.
    """

    what: str
    remedy: str
    suffixes: tuple[str, ...] = ()
    magic: bytes = b""
    mark: bytes = b""
    entry: str = ""


FOREIGN = (
    Foreign(
        what="a Record3D recording",
        suffixes=(".r3d",),
        entry="rgbd/",
        remedy=f"export it in the Record3D app as `EXR + JPG` sequence; {_FOLDER}",
    ),
    Foreign(
        what="an Azure Kinect recording",
        magic=b"\x1a\x45\xdf\xa3",  # Matroska
        mark=b"K4A_",
        remedy=AZURE_KINECT,
    ),
    Foreign(
        what="a ZED recording", suffixes=(".svo", ".svo2"), remedy=f"play it with zed_wrapper (svo_path:=FILE) {_BAG}"
    ),
    Foreign(
        what="a Rerun recording",
        suffixes=(".rrd", ".rbl"),
        magic=b"RRF",
        remedy="give the log that it was made from, or write its images with their poses as an image folder",
    ),
    Foreign(what="an OpenNI recording", suffixes=(".oni",), remedy=f"play it with openni2_camera {_BAG}"),
    Foreign(what="an HDF5 file", suffixes=(".h5", ".hdf5"), magic=b"\x89HDF\r\n\x1a\n", remedy=_TABLE),
    Foreign(what="a Parquet file", suffixes=(".parquet",), magic=b"PAR1", remedy=_TABLE),
    Foreign(what="a LeRobot dataset", entry="meta/info.json", remedy=_TABLE),
    Foreign(what="a TensorFlow dataset", suffixes=(".tfrecord",), entry="dataset_info.json", remedy=_FOLDER),
    Foreign(what="a Zarr store", suffixes=(".zarr",), entry=".zgroup", remedy=_FOLDER),
    Foreign(what="a Python pickle", suffixes=(".pkl", ".pickle"), remedy=_FOLDER),
    Foreign(what="a Project Aria recording", suffixes=(".vrs",), remedy=f"export it with its own tools; {_FOLDER}"),
    Foreign(what="a Kintinuous or ElasticFusion log", suffixes=(".klg",), remedy=f"export its images; {_FOLDER}"),
    Foreign(what="an LCM log", suffixes=(".lcm",), remedy="write its messages as MCAP with ROS 2 or Foxglove types"),
    Foreign(
        what="a packed file",
        suffixes=(".gz", ".tgz", ".bz2", ".xz", ".lz4", ".7z", ".tar", ".zip", ".rar"),
        remedy="unpack it, and give what is in it",
    ),
)


def refuse_foreign(path: Path) -> None:
    """Raise InputError for a known unsupported format, naming it and a conversion."""
    ends, names = (b"", []) if path.is_dir() else (_ends(path), _entries(path))
    for kind in FOREIGN:
        is_named = path.suffix.lower() in kind.suffixes
        is_marked = bool(kind.magic) and ends.startswith(kind.magic) and kind.mark in ends
        holds = kind.entry and ((path / kind.entry).exists() or any(name.startswith(kind.entry) for name in names))
        refuse_if(is_named or is_marked or holds, f"{path}: {kind.what}, which is not read", remedy=kind.remedy)


def _ends(path: Path) -> bytes:
    with path.open("rb") as stream:
        start = stream.read(_ENDS)
        stream.seek(max(len(start), path.stat().st_size - _ENDS))
        return start + stream.read()


def _entries(path: Path) -> list[str]:
    with suppress(zipfile.BadZipFile, NotImplementedError), zipfile.ZipFile(path) as archive:
        return archive.namelist()  # NotImplementedError: of a later version of the format
    return []
