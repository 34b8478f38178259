"""The joint states of a log's topics: which topic, joints spread over several topics, names without a prefix."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.decoder import JOINT_STATE
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.state_clock import checked_stamps
from splatctrl_cli.io.state_messages import NAMELESS, STANDARD_TYPES, STATE_TYPES, TRAJECTORY, RawJoints
from splatctrl_cli.io.state_track import RawTrack
from splatctrl_cli.io.survey import Survey, TopicSurvey
from splatctrl_cli.records import Float64, LossReport

BRIDGED = 0.5  # [s] at most between the states of another topic that a position is interpolated over
STILL = 1e-3  # [rad or m] by which a joint may differ across a longer gap


@dataclass(frozen=True, kw_only=True)
class _Stream:
    """States of one topic that name the same joints."""

    topic: TopicSurvey
    states: list[RawJoints]

    @property
    def where(self) -> str:
        return self.topic.topic.name

    @property
    def names(self) -> tuple[str, ...]:
        return self.states[0].names


def state_topics(survey: Survey, options: SourceOptions, loss: LossReport) -> list[TopicSurvey]:
    """The topics with joint states, planned motions only where nothing measured is there.

    Raises InputError where --joint-topic is none of them.
    """
    found = [t for t in survey.of_type(*STATE_TYPES) if any(joints.names for joints in t.joints)]
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
    measured = [t for t in found if t.topic.type_name != TRAJECTORY]
    return measured or found


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
    streams = _streams([topic])
    chosen = max(streams, key=lambda s: (len(s.names), len(s.states), sorted(s.names)))
    others = len(topic.joints) - len(chosen.states)
    if others:
        loss.notes.append(f"{chosen.where}: {others} of {len(topic.joints)} states name other joints: left out")
    return _raw(chosen, chosen.names, loss)


def track_of_joints(topics: Sequence[TopicSurvey], wanted: Sequence[str], loss: LossReport) -> RawTrack:
    """The states of the joints `wanted` as far as the topics have them, from as few topics as hold them.

    The topic with the most of them gives the stamps, of equals one with end-effector poses, then /joint_states; other
    joints are interpolated between the states of their topics. States outside of these, or in a gap of more than
    `BRIDGED` over which a joint moved, are left out with a note.
    """
    streams = _renamed(_streams(topics), wanted, loss)

    def rank(stream: _Stream) -> tuple[int, bool, bool, int, str]:
        has_poses = any(state.T_base_ee is not None for state in stream.states)
        covered = len(set(stream.names) & set(wanted))
        return (covered, has_poses, stream.where == "/joint_states", len(stream.states), stream.where)

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
    return track if missing else track.of_joints(wanted)


def _streams(topics: Sequence[TopicSurvey]) -> list[_Stream]:
    streams: dict[tuple[str, frozenset[str]], _Stream] = {}
    for topic in topics:
        for state in topic.joints:
            if state.names:
                key = (topic.topic.name, frozenset(state.names))
                streams.setdefault(key, _Stream(topic=topic, states=[])).states.append(state)
    return list(streams.values())


def _renamed(streams: list[_Stream], wanted: Sequence[str], loss: LossReport) -> list[_Stream]:
    """Streams of joint1 ... joint7 under the names of `wanted` that end so, where no stream has those."""
    names = with_prefix(wanted)
    if not names or any(set(stream.names) & set(names.values()) for stream in streams):
        return streams
    loss.notes.append(f"joints without a prefix are taken by their number: joint1 is {names['joint1']}, and so on")
    return [
        replace(s, states=[replace(state, names=tuple(names.get(n, n) for n in state.names)) for state in s.states])
        for s in streams
    ]


def with_prefix(wanted: Sequence[str]) -> dict[str, str]:
    """joint1 ... joint7 -> the names of `wanted` that end so after one prefix; empty unless one prefix fits."""
    first = NAMELESS[0]
    prefixes = [name.removesuffix(first) for name in wanted if name.endswith(first)]
    fitting = [prefix for prefix in prefixes if all(prefix + short in wanted for short in NAMELESS)]
    return {short: fitting[0] + short for short in NAMELESS} if len(fitting) == 1 else {}


def _raw(stream: _Stream, names: tuple[str, ...], loss: LossReport) -> RawTrack:
    """The states of a stream with `names` as columns."""
    states = stream.states
    orders: dict[tuple[str, ...], list[int]] = {}
    for state in states:
        if state.names not in orders:
            orders[state.names] = [state.names.index(name) for name in names]
    log_ns = np.array([state.log_time_ns for state in states], dtype=np.int64)
    stamp_ns = np.array([state.stamp_ns for state in states], dtype=np.int64)
    poses = [state.T_base_ee for state in states]
    return RawTrack(
        where=stream.where,
        names=names,
        stamp_ns=checked_stamps(stamp_ns, log_ns, stream.where, loss),
        position=np.array([s.position[orders[s.names]] for s in states]),
        velocity=_columns(states, [s.velocity for s in states], orders),
        commanded_velocity=_columns(states, [s.commanded_velocity for s in states], orders)
        if any(len(s.commanded_velocity) for s in states)
        else None,
        T_base_ee=None
        if all(T is None for T in poses)
        else np.array([np.full((4, 4), np.nan) if T is None else T for T in poses]),
    )


def _columns(states: list[RawJoints], values: list[Float64], orders: dict[tuple[str, ...], list[int]]) -> Float64:
    """values (T, J) in order, NaN where a state has none."""
    rows = []
    for state, row in zip(states, values, strict=True):
        order = orders[state.names]
        rows.append(row[order] if len(row) else np.full(len(order), np.nan))
    return np.array(rows)


def _filled(track: RawTrack, other: RawTrack, loss: LossReport) -> RawTrack:
    """`track` with the joints of `other`, interpolated at its stamps; states where that cannot be are left out."""
    order = np.argsort(other.stamp_ns, kind="stable")
    at, values = other.stamp_ns[order], other.position[order]
    stamps = track.stamp_ns
    after = np.clip(np.searchsorted(at, stamps), 1, max(len(at) - 1, 1))
    if len(at) == 1:
        at, values, order = np.repeat(at, 2), np.repeat(values, 2, axis=0), np.repeat(order, 2)
    before = after - 1
    gap = (at[after] - at[before]) * 1e-9
    is_still = np.abs(values[after] - values[before]).max(axis=1) < STILL
    keep = (stamps >= at[0]) & (stamps <= at[-1]) & ((gap <= BRIDGED) | is_still)
    share = np.clip((stamps - at[before]) / np.maximum(at[after] - at[before], 1), 0.0, 1.0)[:, None]

    def between(rows: Float64) -> Float64:
        return np.asarray((1 - share) * rows[order][before] + share * rows[order][after])

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
    commanded = track.commanded_velocity
    filled = RawTrack(
        where=track.where,
        names=(*track.names, *other.names),
        stamp_ns=stamps,
        position=np.hstack([track.position, between(other.position)]),
        velocity=np.hstack([track.velocity, between(other.velocity)]),
        commanded_velocity=None
        if commanded is None or other.commanded_velocity is None
        else np.hstack([commanded, between(other.commanded_velocity)]),
        T_base_ee=track.T_base_ee,
        T_world_ee=track.T_world_ee,
    )
    return filled.select(keep)
