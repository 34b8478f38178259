"""A frame together with how its source stored it, so that `ingest` can keep what is lossless without decoding it."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import PLAUSIBLE_DEPTH, UNIT_DEPTH
from splatctrl_cli.containers.raw_log import RawMessage
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.image_file import JPEG, PNG
from splatctrl_cli.logs.decoder import UndecodableMessageError
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.records import (
    Bool,
    Float32,
    Float64,
    Intrinsics,
    JointState,
    Record,
    RecordSource,
    RgbdFrame,
    UInt8,
)


@dataclass(frozen=True, kw_only=True)
class StoredFrame:
    """A frame whose images are decoded when they are asked for, and how its source stored them: `ingest` keeps files.

    read_color, read_depth: give the frame's color and depth, or raise UndecodableMessageError;
    color_file: the bytes of a JPEG or PNG that decode to exactly the frame's color, None where there are none;
    depth_file: those of a 16-bit PNG of which the depth is exactly ``counts * float32(depth_unit)``, or None;
    depth_unit: [m] of which every depth is a uint16 multiple (``counts * float32(unit)``), None if there is none.
    origin: where it came from, in words; places: the colour and the depth message without their bytes, empty where
    there are none.
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
        """Of the frame. Raises InputError where the image does not decode."""
        with self._refused():
            return self.read_color()

    @cached_property
    def depth(self) -> Float32:
        """Of the frame. Raises InputError where the image does not decode."""
        with self._refused():
            return self.read_depth()

    @property
    def frame(self) -> RgbdFrame:
        """The frame, with both images decoded. Raises InputError where one does not."""
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

    @contextmanager
    def _refused(self) -> Iterator[None]:
        try:
            yield
        except UndecodableMessageError as error:
            raise InputError(f"{self.origin}: {error}", remedy="copy the recording again") from None


class FrameSource(RecordSource, Protocol):
    """A record source that also says how its frames were stored."""

    @property
    def world_frame(self) -> str:
        """The frame of poses, as the source names it."""
        ...

    @property
    def states(self) -> StateColumns:
        """The joint states, by stamp, without a pass over the frames."""
        ...

    def stored(self) -> Iterator[StoredFrame | JointState]:
        """As `records`, with the frames as they are stored."""
        ...

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Stamp [ns], camera and T_world_camera (4, 4) of each frame, by stamp, without its images."""
        ...


def is_kept(data: bytes | None) -> bool:
    """Whether an image file's bytes are of a kind that captures hold: JPEG or PNG."""
    return data is not None and data.startswith((JPEG, PNG))


def is_png(data: bytes | None) -> bool:
    """Whether these are the bytes of a PNG file."""
    return data is not None and data.startswith(PNG)


def decoded(items: Iterable[StoredFrame | JointState]) -> Iterator[Record]:
    """The same records, their frames decoded."""
    return (item.frame if isinstance(item, StoredFrame) else item for item in items)


def human_mask(pixels: NDArray[Any], camera: Intrinsics, where: str) -> UInt8:
    """(H, W) uint8, 1 where an image file or message is not 0. Raises InputError unless 8-bit grey, (H, W)."""
    if pixels.dtype != np.uint8 or pixels.shape != (camera.height, camera.width):
        size = "x".join(map(str, reversed(pixels.shape[:2])))
        channels = pixels.shape[2] if pixels.ndim == 3 else 1
        raise InputError(
            f"{where}: expected an 8-bit grey mask of {camera.width}x{camera.height}, as the colour images,"
            f" got {size} of {channels} channel(s), {pixels.dtype}",
            remedy="write 0 where there is no person, anything else where there is one",
        )
    return np.asarray(pixels != 0, np.uint8)


def check_depth(depth: Float32, where: str, scale: float) -> bool:
    """Whether a depth image [m] holds any depth; raises InputError when its median is implausible.

    `scale` [m per count] is what turned counts into metres.
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
