"""The views of a recording that are scored, each with what the training cameras had seen by then."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from splatctrl_cli.records import RecordSource, RgbdFrame


@dataclass(frozen=True, kw_only=True)
class View:
    """A frame to score, its name (camera and number), and the training frames that count as known at its time."""

    name: str
    frame: RgbdFrame
    training: tuple[RgbdFrame, ...]


def views_to_score(
    source: RecordSource, *, scoring: Collection[str], training: Collection[str], has_clock: bool
) -> Iterator[View]:
    """The frames of the `scoring` cameras in time order.

    With a clock, what counts is the newest frame of each training camera not later than the view (a frame of the same
    stamp counts); without one, every training frame of the recording, which is then read twice.
    """
    names = _Names()
    if not has_clock:
        known = tuple(frame for frame in _frames(source) if frame.camera in training)
        for frame in _frames(source):
            if frame.camera in scoring:
                yield View(name=names.next(frame.camera), frame=frame, training=known)
        return
    newest: dict[str, RgbdFrame] = {}
    for moment in _moments(source):
        newest |= {frame.camera: frame for frame in moment if frame.camera in training}
        for frame in moment:
            if frame.camera in scoring:
                yield View(name=names.next(frame.camera), frame=frame, training=tuple(newest.values()))


class _Names:
    """Numbers the frames of each camera: ``cam3-0000``, ``cam3-0001``, …; fit for file names."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def next(self, camera: str) -> str:
        number = self._counts.get(camera, 0)
        self._counts[camera] = number + 1
        return f"{camera.strip('/').replace('/', '_')}-{number:04d}"


def _frames(source: RecordSource) -> Iterator[RgbdFrame]:
    return (record for record in source.records() if isinstance(record, RgbdFrame))


def _moments(source: RecordSource) -> Iterator[list[RgbdFrame]]:
    """Frames of the same stamp, together."""
    moment: list[RgbdFrame] = []
    for frame in _frames(source):
        if moment and frame.stamp_ns != moment[0].stamp_ns:
            yield moment
            moment = []
        moment.append(frame)
    if moment:
        yield moment
