"""The views of a recording that are scored, each with what the training cameras had seen by then."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from splatctrl_cli.records import RecordSource, RgbdFrame


@dataclass(frozen=True, kw_only=True)
class View:
    """A frame to score, its name, and the training frames that count as known at its time.

    The name is the camera and a number: with a clock among the camera's frames, without one among all views, or the
    stamp where stamps are the views' own numbers.
    """

    name: str
    frame: RgbdFrame
    training: tuple[RgbdFrame, ...]


def views_to_score(
    source: RecordSource,
    *,
    scoring: Collection[str],
    training: Collection[str],
    has_clock: bool,
    numbered_by_stamp: bool = False,
) -> Iterator[View]:
    """The frames of the `scoring` cameras in time order.

    With a clock, what counts is the newest frame of each training camera not later than the view (a frame of the same
    stamp counts); without one, every training frame of the recording, which is then read twice.
    """
    if not has_clock:
        known = tuple(frame for frame in _frames(source) if frame.camera in training)
        for number, frame in enumerate(_frames(source)):
            if frame.camera in scoring:
                name = _name(frame.camera, frame.stamp_ns if numbered_by_stamp else number)
                yield View(name=name, frame=frame, training=known)
        return
    counts: Counter[str] = Counter()
    newest: dict[str, RgbdFrame] = {}
    for moment in _moments(source):
        newest |= {frame.camera: frame for frame in moment if frame.camera in training}
        for frame in moment:
            if frame.camera in scoring:
                name = _name(frame.camera, counts[frame.camera])
                yield View(name=name, frame=frame, training=tuple(newest.values()))
                counts[frame.camera] += 1


def _name(camera: str, number: int) -> str:
    """``cam3-0000``: fit for a file name."""
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
