"""The joint states of a log's topics: which topic, joints spread over several topics, names without a prefix; and
which of two clocks the log goes by: what stamped the messages, or what logged them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.config.fixed import (
    CLOCK_DRIFT,
    CLOCK_MIXED,
    CLOCK_NEIGHBOURS,
    CLOCK_OTHER,
    CLOCK_STEP,
    STATES_BRIDGED,
    STATES_STILL,
)
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.spilled_rows import RowFile, Rows, Table, absent, ranges
from splatctrl_cli.logs.decoder import JOINT_STATE
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.logs.state_columns import NO_STATES, StateColumns
from splatctrl_cli.logs.state_messages import NAMELESS, STANDARD_TYPES, STATE_TYPES, TRAJECTORY, JointStream
from splatctrl_cli.logs.state_track import RawTrack, cleaned
from splatctrl_cli.logs.survey import Survey, TopicSurvey
from splatctrl_cli.records import Bool, Float64, Index, LossReport, Stamps


@dataclass(frozen=True, kw_only=True)
class _Stream:
    """States of one topic that name the same joints, under the names to take them by."""

    where: str
    names: tuple[str, ...]
    states: JointStream

    @property
    def has_poses(self) -> bool:
        return "T_base_ee" in self.states.columns()


def joint_records(
    survey: Survey, options: SourceOptions, loss: LossReport, wanted: Sequence[str] | None = None
) -> tuple[tuple[str, ...], StateColumns]:
    """Joint names and states by stamp; no names and no states where the log holds none.

    With `wanted` (a robot's joints), they are brought together from the topics that have them. Else the states are of
    one topic, and those that lack a joint of the fullest (a gripper that publishes alone) are left out with a note.
    """
    topics = state_topics(survey, options, loss)
    if not topics:
        return (), NO_STATES
    raw = track_of_topic(main_topic(topics, loss), loss) if wanted is None else track_of_joints(topics, wanted, loss)
    states = cleaned(raw, loss)
    return (raw.names, states) if len(states) else ((), NO_STATES)


def state_topics(survey: Survey, options: SourceOptions, loss: LossReport) -> list[TopicSurvey]:
    """The topics with joint states, planned motions only where nothing measured is there.

    Raises InputError where --joint-topic is none of them.
    """
    found = [t for t in survey.of_type(*STATE_TYPES) if t.joints.streams]
    for topic in survey.of_type(*STATE_TYPES):
        if not topic.topic.definition and topic.topic.type_name not in STANDARD_TYPES:
            kind = topic.topic.type_name
            loss.notes.append(f"{topic.topic.name}: the log has no definition of {kind}: its states are not read")
    if options.joint_topic is not None:
        chosen = [t for t in found if t.topic.name == options.joint_topic]
        if not chosen:
            raise InputError(
                f"joint topic {options.joint_topic}: not a topic of the log with joint states",
                remedy=f"use one of: {', '.join(t.topic.name for t in found) or 'none there'}",
            )
        return chosen
    return [t for t in found if t.topic.type_name != TRAJECTORY] or found


def main_topic(topics: Sequence[TopicSurvey], loss: LossReport) -> TopicSurvey:
    """/joint_states, else the JointState topic with most messages, else the fullest of another type."""

    def rank(topic: TopicSurvey) -> tuple[bool, bool, int, str]:
        name = topic.topic.name
        return (name == "/joint_states", topic.topic.type_name == JOINT_STATE, topic.count, name)

    chosen = max(topics, key=rank)
    others = sorted(t.topic.name for t in topics if t is not chosen)
    if others:
        loss.notes.append(f"joint states are taken from {chosen.topic.name}, not from {', '.join(others)}")
    return chosen


def track_of_topic(topic: TopicSurvey, loss: LossReport) -> RawTrack:
    """The states of a topic that name the most joints; others (a gripper that publishes alone) are noted."""
    chosen = max(_streams([topic]), key=lambda s: (len(s.names), len(s.states), sorted(s.names)))
    others = len(topic.joints) - len(chosen.states)
    if others:
        loss.notes.append(f"{chosen.where}: {others} of {len(topic.joints)} states name other joints: left out")
    return _raw(chosen, chosen.names, loss)


def track_of_joints(topics: Sequence[TopicSurvey], wanted: Sequence[str], loss: LossReport) -> RawTrack:
    """The states of the joints `wanted` as far as the topics have them, from as few topics as hold them.

    The topic with the most of them gives the stamps, of equals one with end-effector poses, then /joint_states; other
    joints are interpolated between the states of their topics. States outside of these, or in a gap of more than
    `STATES_BRIDGED` over which a joint moved, are left out with a note.
    """
    streams = _renamed(_streams(topics), wanted, loss)

    def rank(stream: _Stream) -> tuple[int, bool, bool, int, str]:
        covered = len(set(stream.names) & set(wanted))
        return (covered, stream.has_poses, stream.where == "/joint_states", len(stream.states), stream.where)

    base = max(streams, key=rank)
    track = _raw(base, base.names, loss)
    missing = [name for name in wanted if name not in base.names]
    used = [base.where]
    while missing:
        best = max(streams, key=lambda s: (len(set(s.names) & set(missing)), len(s.states), s.where))
        added = tuple(name for name in missing if name in best.names)
        if not added:
            break
        track = _filled(track, _raw(best, added, loss), loss)
        missing = [name for name in missing if name not in added]
        used.append(best.where)
    others = sorted({t.topic.name for t in topics} - set(used))
    if others:
        taken = ", ".join(dict.fromkeys(used))
        loss.notes.append(f"joint states are taken from {taken}, not from {', '.join(others)}")
    return track if missing else track.of_names(wanted)


def _streams(topics: Sequence[TopicSurvey]) -> list[_Stream]:
    return [
        _Stream(where=topic.topic.name, names=stream.names, states=stream)
        for topic in topics
        for stream in topic.joints.streams
    ]


def _renamed(streams: list[_Stream], wanted: Sequence[str], loss: LossReport) -> list[_Stream]:
    """Streams of joint1 ... joint7 under the names of `wanted` that end so, where no stream has those."""
    names = with_prefix(wanted)
    if not names or any(set(stream.names) & set(names.values()) for stream in streams):
        return streams
    loss.notes.append(f"joints without a prefix are taken by their number: joint1 is {names['joint1']}, and so on")
    return [replace(s, names=tuple(names.get(name, name) for name in s.names)) for s in streams]


def with_prefix(wanted: Sequence[str]) -> dict[str, str]:
    """joint1 ... joint7 -> the names of `wanted` that end so after one prefix; empty unless one prefix fits."""
    first = NAMELESS[0]
    prefixes = [name.removesuffix(first) for name in wanted if name.endswith(first)]
    fitting = [prefix for prefix in prefixes if all(prefix + short in wanted for short in NAMELESS)]
    return {short: fitting[0] + short for short in NAMELESS} if len(fitting) == 1 else {}


def _raw(stream: _Stream, names: tuple[str, ...], loss: LossReport) -> RawTrack:
    """The states of a stream with `names` as columns."""
    states, columns = stream.states, stream.states.columns()
    raw = RawTrack(
        where=stream.where,
        names=stream.names,
        stamp_ns=checked_stamps(states.stamp_ns, states.log_time_ns, stream.where, loss),
        **{"velocity": absent(len(states), len(stream.names)), **columns},
    )
    return raw.of_names(names)


def _filled(track: RawTrack, other: RawTrack, loss: LossReport) -> RawTrack:
    """`track` with the joints of `other`, interpolated at its stamps; states where that cannot be are left out."""
    order = np.argsort(other.stamp_ns, kind="stable")
    at = other.stamp_ns[order]
    stamps = track.stamp_ns
    after = np.clip(np.searchsorted(at, stamps), 1, max(len(at) - 1, 1))
    if len(at) == 1:
        at, order = np.repeat(at, 2), np.repeat(order, 2)
    before = after - 1
    gap = (at[after] - at[before]) * 1e-9
    is_still = _is_still(other.position, order[before], order[after])
    keep = (stamps >= at[0]) & (stamps <= at[-1]) & ((gap <= STATES_BRIDGED) | is_still)
    share = np.clip((stamps - at[before]) / np.maximum(at[after] - at[before], 1), 0.0, 1.0)[:, None]

    names = ", ".join(other.names)
    if not keep.any():
        raise InputError(
            f"{track.where} and {other.where}: mixed clocks: at no state of {track.where} is {names} known",
            remedy="give another --joint-topic, or record both by one clock",
        )
    loss.notes.append(f"{track.where}: {names} of {other.where} are interpolated at its {len(stamps)} states")
    if not keep.all():
        lost = f"{int((~keep).sum())} of {len(stamps)} states left out"
        loss.notes.append(f"{track.where}: {lost}: {names} of {other.where} are unknown then")

    def joined(one: Table, two: Table) -> Table:
        file = RowFile((len(track.names) + len(other.names),))
        for first, last in ranges(len(stamps)):
            part = slice(first, last)
            between = (1 - share[part]) * two[order[before[part]]] + share[part] * two[order[after[part]]]
            file.append(np.hstack([one[part], between]))
        return Rows(file)

    one, two = track.commanded_velocity, other.commanded_velocity
    filled = replace(
        track,
        names=(*track.names, *other.names),
        position=joined(track.position, other.position),
        velocity=joined(track.velocity, other.velocity),
        commanded_velocity=None if one is None or two is None else joined(one, two),
    )
    return filled.select(np.flatnonzero(keep))


def _is_still(table: Table, before: Index, after: Index) -> Bool:
    """Pairs of states (T,) of which no joint differs."""
    is_still = np.zeros(len(before), dtype=np.bool_)
    for first, last in ranges(len(before)):
        change = np.abs(table[after[first:last]] - table[before[first:last]])
        is_still[first:last] = change.max(axis=1) < STATES_STILL
    return is_still


def checked_stamps(stamp_ns: Stamps, log_ns: Stamps, where: str, loss: LossReport) -> Stamps:
    """The stamps (T,) [ns] to use, in file order: those of the headers, or the log's where no header has one.

    Notes another clock, a drift and steps in `loss`. Raises InputError for states of two clocks.
    """
    is_unset = stamp_ns == 0
    if is_unset.all():
        loss.notes.append(f"{where}: no state has a stamp; the times of logging are used")
        return log_ns
    if is_unset.any() and stamp_ns[~is_unset].min() > CLOCK_MIXED * 1e9:  # a simulation may begin at 0
        raise InputError(
            f"{where}: mixed clocks: {int(is_unset.sum())} of {len(stamp_ns)} states have no stamp",
            remedy="leave them out of the log, or give another --joint-topic",
        )
    late = np.asarray((log_ns - stamp_ns) * 1e-9, dtype=np.float64)
    _check_steps(late, where, loss)
    median = float(np.median(late))
    if abs(median) > CLOCK_OTHER:
        loss.notes.append(
            f"{where}: stamps are {abs(median):.3f} s {'before' if median > 0 else 'after'} the time of logging: "
            "two clocks; are the cameras stamped by the same one?"
        )
    drift, span = _drift(late, np.asarray((stamp_ns - stamp_ns[0]) * 1e-9, dtype=np.float64))
    if abs(drift) > CLOCK_DRIFT:
        loss.notes.append(
            f"{where}: stamps and times of logging drift apart by {1e3 * abs(drift):.1f} ms over {span:.1f} s "
            f"({1e6 * abs(drift) / span:.0f} ppm)"
        )
    return stamp_ns


def _check_steps(late: Float64, where: str, loss: LossReport) -> None:
    n = CLOCK_NEIGHBOURS
    if len(late) < 2 * n:
        if np.ptp(late) > CLOCK_MIXED:
            raise _mixed(where, float(np.ptp(late)), int(np.argmax(np.abs(np.diff(late)))) + 1)
        return
    windows = np.empty(len(late) - n + 1)
    for first, last in ranges(len(windows)):
        near = late[first : last + n - 1]
        windows[first:last] = np.median(np.lib.stride_tricks.sliding_window_view(near, n), axis=1)
    change = np.abs(windows[n:] - windows[:-n])  # the n states before i + n against those from it on
    step = float(change.max(initial=0.0))
    if step <= CLOCK_STEP:
        return
    at = int(np.argmax(change))
    state = at + 1 + int(np.argmax(np.abs(np.diff(late[at : at + 2 * n]))))
    if step > CLOCK_MIXED:
        raise _mixed(where, step, state)
    loss.notes.append(f"{where}: stamps step by {step:.3f} s against the time of logging at state {state}")


def _mixed(where: str, step: float, state: int) -> InputError:
    return InputError(
        f"{where}: mixed clocks: stamps jump by {step:.1f} s against the time of logging at state {state}",
        remedy="cut the log there, or give another --joint-topic",
    )


def _drift(late: Float64, seconds: Float64) -> tuple[float, float]:
    """How much later [s] the last quarter is logged than the first, and the seconds between them.

    Of each quarter the tenth percentile counts: a message may be logged late, but not early. 0 where the change is
    not spread over the log (a step, a stall).
    """
    quarter = len(late) // 4
    span = float(np.median(seconds[-quarter:]) - np.median(seconds[:quarter])) if quarter >= 10 else 0.0
    if span <= 0:
        return 0.0, 1.0
    first, last = late[:quarter], late[-quarter:]
    drift = float(np.percentile(last, 10) - np.percentile(first, 10))
    halves = float(np.percentile(late[quarter:-quarter], 10) - np.percentile(first, 10))
    is_even = 0.1 < halves / drift < 0.9 if drift else False
    return (drift if is_even else 0.0), span
