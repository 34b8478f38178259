"""Frames and joint states as their source stored them, which `ingest` keeps without decoding.

joint_topics/K/ has stamp_ns.npy, log_time_ns.npy (T,) int64, and float64 columns: position.npy and, if any,
velocity.npy, commanded_velocity.npy (T, J), T_base_ee.npy (T, 4, 4). capture.json describes each K.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from io import BytesIO
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import PLAUSIBLE_DEPTH, UNIT_DEPTH
from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.files.spilled_rows import Table, blocks_of, ranges
from splatctrl_cli.formats.arrays import npy_head, npy_of
from splatctrl_cli.formats.image_file import JPEG, PNG
from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.recording.log.decoder import UndecodableMessageError
from splatctrl_cli.recording.log.state_columns import NO_STATES, StateColumns
from splatctrl_cli.recording.log.state_messages import JointLog, JointStream
from splatctrl_cli.recording.log.survey import TopicSurvey
from splatctrl_cli.records import (
    Bool,
    Float32,
    Float64,
    Intrinsics,
    JointState,
    LossReport,
    Record,
    RgbdFrame,
    UInt8,
    merge_by_stamp,
)

_Image = TypeVar("_Image")
FOLDER = "joint_topics"
AGAIN = "run `splatctrl ingest` again"


@dataclass(frozen=True, kw_only=True)
class JointTopics:
    """Topics with joint states, their `loss` and the user's chosen topic.

    first_note: index of the loss's first note in the whole report.
    """

    topics: Sequence[TopicSurvey]
    loss: LossReport
    first_note: int
    chosen: str | None = None


def merge_joints(loss: LossReport, joints: LossReport, at: int, *, sign: int = 1) -> LossReport:
    """Add the joints' report to `loss`, notes at index `at`; subtract with sign -1."""
    added, after = (joints.notes, at) if sign > 0 else ([], at + len(joints.notes))
    return loss.plus(joints, [*loss.notes[:at], *added, *loss.notes[after:]], sign=sign)


def write_topics(folder: Path, joints: JointTopics, wrote: Callable[[str], None]) -> dict[str, Any]:
    """Write streams into a capture, calling `wrote` with each file. Returns the capture.json entry."""
    described, number = [], 0
    for topic in joints.topics:
        streams = []
        for stream in topic.joints.streams.values():
            place = f"{FOLDER}/{number}"
            (folder / place).mkdir(parents=True)
            number += 1
            times = {"stamp_ns": stream.stamp_ns, "log_time_ns": stream.log_time_ns}
            for name, values in times.items():
                np.save(folder / place / f"{name}.npy", values, allow_pickle=False)
            columns = stream.columns()
            for name, rows in columns.items():
                with (folder / place / f"{name}.npy").open("wb") as file:
                    write_rows(file, rows)
            for name in (*times, *columns):
                wrote(f"{place}/{name}.npy")
            streams.append({"folder": place, "joints": list(stream.names), "columns": list(columns)})
        described.append(
            {
                "topic": topic.topic.name,
                "type": topic.topic.type_name,
                "messages": topic.count,
                "has_definition": bool(topic.topic.definition),
                "states": topic.joints.num,
                "streams": streams,
            }
        )
    return {
        "topics": described,
        "chosen": joints.chosen,
        "loss": {"counts": asdict(joints.loss), "first_note": joints.first_note},
    }


def read_topics(folder: Path, described: Mapping[str, Any], checked: Callable[[str], Path]) -> JointTopics:
    """Read what `write_topics` wrote; `checked` returns the path of an unchanged file.

    Raises InputError if damaged.
    """
    with refuse_faults(
        f"{folder / FOLDER}: cannot be read", KeyError, TypeError, ValueError, OSError, EOFError, remedy=AGAIN
    ):
        topics = [_topic(entry, checked) for entry in described["topics"]]
        loss = LossReport(**described["loss"]["counts"])
        first_note, chosen = int(described["loss"]["first_note"]), described["chosen"]
    return JointTopics(topics=topics, loss=loss, first_note=first_note, chosen=chosen)


def _topic(entry: Mapping[str, Any], checked: Callable[[str], Path]) -> TopicSurvey:
    streams = []
    for stream in entry["streams"]:
        place = stream["folder"]
        stamps, log_times = (
            np.asarray(npy_of(checked(f"{place}/{name}.npy").read_bytes()), dtype=np.int64)
            for name in ("stamp_ns", "log_time_ns")
        )
        columns = {name: _blocks(checked(f"{place}/{name}.npy")) for name in stream["columns"]}
        streams.append(JointStream(tuple(stream["joints"]), stamps, log_times, columns))
    return TopicSurvey(
        topic=Topic(
            name=entry["topic"],
            type_name=entry["type"],
            encoding="cdr",
            definition="kept" if entry["has_definition"] else "",
        ),
        count=int(entry["messages"]),
        joints=JointLog(streams, int(entry["states"])),
    )


def write_rows(stream: IO[bytes], rows: Table) -> None:
    """Write float64 as .npy, a block at a time."""
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": tuple(rows.shape)})
    stream.writelines(np.ascontiguousarray(block, dtype="<f8").tobytes() for block in blocks_of(rows))


def npy_bytes(depth: Float32) -> bytes:
    """The .npy of a depth image (H, W)."""
    stream = BytesIO()
    np.save(stream, np.ascontiguousarray(depth, dtype="<f4"), allow_pickle=False)
    return stream.getvalue()


def _blocks(path: Path) -> Iterator[Float64]:
    with path.open("rb") as stream:
        shape, is_by_columns, dtype = npy_head(stream)
        refuse_if(
            dtype != np.dtype("<f8") or is_by_columns or not shape,
            f"{path.name}: expected rows of float64, got {dtype} {shape}",
            error=ValueError,
        )
        refuse_if(
            8 * prod(shape) != path.stat().st_size - stream.tell(),
            f"{path.name}: does not hold the {shape[0]} rows that it announces",
            error=ValueError,
        )
        for first, last in ranges(shape[0]):
            size = (last - first) * prod(shape[1:])
            values = np.frombuffer(stream.read(8 * size), dtype)  # no map: a file that shrinks would kill the program
            refuse_if(
                values.size != size,
                f"{path.name}: ends after {first + values.size} of {shape[0]} rows",
                error=ValueError,
            )
            yield values.reshape(last - first, *shape[1:])


@dataclass(frozen=True, kw_only=True)
class StoredFrame:
    """A frame whose images decode on demand, with their files as the source stored them.

    read_color, read_depth: return the image, or raise UndecodableMessageError. color_file: JPEG or PNG bytes of
    exactly the color. depth_file: 16-bit PNG whose ``counts * float32(depth_unit)`` is exactly the depth. depth_unit
    [m]: every depth is a uint16 multiple of it. These three may be None. origin: the source in words. places: the
    messages, without data.
    """

    stamp_ns: int
    camera: str
    intrinsics: Intrinsics
    T_world_camera: Float64
    read_color: Callable[[], UInt8]
    read_depth: Callable[[], Float32]
    color_file: bytes | None
    depth_unit: float | None
    origin: str
    human: UInt8 | None = None
    valid: Bool | None = None
    places: tuple[RawMessage, ...] = ()
    depth_file: bytes | None = None

    @cached_property
    def color(self) -> UInt8:
        """Raises InputError if undecodable."""
        return self._read(self.read_color)

    @cached_property
    def depth(self) -> Float32:
        """Raises InputError if undecodable."""
        return self._read(self.read_depth)

    @property
    def frame(self) -> RgbdFrame:
        """Raises InputError if undecodable."""
        return RgbdFrame(
            stamp_ns=self.stamp_ns,
            camera=self.camera,
            color=self.color,
            depth=self.depth,
            intrinsics=self.intrinsics,
            T_world_camera=self.T_world_camera,
            human=self.human,
            valid=self.valid,
        )

    def _read(self, read: Callable[[], _Image]) -> _Image:
        with refuse_faults(self.origin, UndecodableMessageError, remedy="copy the recording again"):
            return read()


class FrameSource:
    """A `RecordSource` in stamp order: joint states, and frames as stored.

    world_frame: of the source's poses. states: by stamp, known without reading frames. joint_topics: a log's, None if
    unknown. depth_fault: why no frame has depth (image folders only), None if some may. tf_frames:
    T_world_frame (4, 4) [m] by tf frame, None if tf moves it.
    """

    name: str
    cameras: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()
    has_clock: bool = True
    world_frame: str
    states: StateColumns = NO_STATES
    joint_topics: JointTopics | None = None
    depth_fault: InputError | None = None
    tf_frames: Mapping[str, Float64 | None] = MappingProxyType({})

    @property
    def loss(self) -> LossReport:
        """Complete once `records` is exhausted."""
        raise NotImplementedError

    def digests(self) -> dict[str, str]:
        """sha256 of every input file, by name."""
        return dict(self._digests)

    @cached_property
    def _digests(self) -> dict[str, str]:
        raise NotImplementedError

    def records(self) -> Iterator[Record]:
        return decoded(self.stored())

    def stored(self) -> Iterator[StoredFrame | JointState]:
        """Yield `records`, undecoded."""
        return merge_by_stamp(self.states, self._frames())

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Yield (stamp [ns], camera, T_world_camera (4, 4)) in stamp order, without images."""
        return iter(())

    def _frames(self) -> Iterator[StoredFrame]:
        return iter(())


def is_kept(data: bytes | None, *kinds: bytes) -> bool:
    """True if `data` begins as one of `kinds`, by default JPEG or PNG."""
    return data is not None and data.startswith(kinds or (JPEG, PNG))


def decoded(items: Iterable[StoredFrame | JointState]) -> Iterator[Record]:
    return (item.frame if isinstance(item, StoredFrame) else item for item in items)


def human_mask(pixels: NDArray[Any], camera: Intrinsics, where: str) -> UInt8:
    """Mask (H, W) uint8, 1 where `pixels` are not 0.

    Raises InputError unless 8-bit grey of the camera's size.
    """
    size = "x".join(map(str, reversed(pixels.shape[:2])))
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    refuse_if(
        pixels.dtype != np.uint8 or pixels.shape != (camera.height, camera.width),
        f"{where}: expected an 8-bit grey mask of {camera.width}x{camera.height}, as the colour images,"
        f" got {size} of {channels} channel(s), {pixels.dtype}",
        remedy="write 0 where there is no person, anything else where there is one",
    )
    return np.asarray(pixels != 0, np.uint8)


def check_depth(depth: Float32, where: str, scale: float) -> bool:
    """True if a depth image [m] has any depth. Raises InputError for an implausible median.

    scale: metres per count by which `depth` was read.
    """
    valid = depth[depth > 0]
    if valid.size == 0:
        return False
    median = float(np.median(valid))
    low, high = PLAUSIBLE_DEPTH
    if not low <= median <= high:
        counts = median / scale
        nearest, farthest = UNIT_DEPTH
        fits = [s for s in (1e-3, 1e-4, 1.0, 1e-2, 1e-5, 1e-6) if nearest <= counts * s <= farthest]
        remedy = f"give --depth-scale {fits[0]:g}" if fits else "give the right --depth-scale [m per count]"
        raise InputError(
            f"{where}: median depth {median:.4g} m is implausible (expected {low:g} to {high:g} m)",
            remedy=f"is the depth scale {scale:g} m per count wrong? {remedy}",
        )
    return True
