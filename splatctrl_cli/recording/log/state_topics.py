"""Joint states of a log's topics: chosen, merged, renamed, clocks checked."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatctrl_cli.config.fixed import (
    CLOCK_DRIFT,
    CLOCK_MIXED,
    CLOCK_NEIGHBOURS,
    CLOCK_OTHER,
    CLOCK_STEP,
    STATES_BRIDGED,
    STATES_COMPARED,
    STATES_RIVAL,
    STATES_STILL,
    TURNS_ACCELERATION,
    TURNS_FEWEST,
    TURNS_LEAST,
    TURNS_SHARE,
)
from splatctrl_cli.errors import InputError, NotEvaluableError, SplatCtrlError, refuse_if
from splatctrl_cli.files.spilled_rows import RowFile, Rows, Table, absent, ranges
from splatctrl_cli.recording.log.decoder import JOINT_STATE
from splatctrl_cli.recording.log.state_columns import NO_STATES, StateColumns
from splatctrl_cli.recording.log.state_messages import STANDARD_TYPES, STATE_TYPES, TRAJECTORY
from splatctrl_cli.recording.log.state_track import RawTrack, clean_states, unwrap
from splatctrl_cli.recording.log.survey import Survey, TopicSurvey
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Bool, Float64, Index, LossReport, Stamps

_COMMANDS = ("command", "cmd", "desired", "target", "goal", "reference", "setpoint")  # in names of command topics


def joint_records(
    survey: Survey, options: SourceOptions, loss: LossReport, joints: Sequence[str] | None = None
) -> tuple[tuple[str, ...], StateColumns]:
    """Joint names and states by stamp; both empty if the log has none.

    With `joints` (a robot's), their topics are merged. Else one topic is used: its states with the most joints; the
    others are left out with a note.
    """
    topics = state_topics(survey, options, loss)
    if not topics:
        return (), NO_STATES
    try:
        refuse_contradiction(topics, joints)
    except SplatCtrlError as wrong:
        if joints is not None:
            raise
        loss.notes.append(wrong.message)
    loss.notes += [f"{t.topic.name}: {note} ({num} states)" for t in topics for note, num in t.joints.notes.items()]
    raw = track_of_topic(main_topic(topics, loss), loss) if joints is None else track_of_joints(topics, joints, loss)
    states = clean_states(raw, loss)
    return (raw.names, states) if len(states) else ((), NO_STATES)


def state_topics(survey: Survey, options: SourceOptions, loss: LossReport) -> list[TopicSurvey]:
    """Topics with states; planned motions only if nothing is measured.

    Raises InputError for an unknown --joint-topic.
    """
    topics = [t for t in survey.select_types(*STATE_TYPES) if t.joints.streams]
    for topic in survey.select_types(*STATE_TYPES):
        if not topic.topic.definition and topic.topic.type_name not in STANDARD_TYPES:
            kind = topic.topic.type_name
            loss.notes.append(f"{topic.topic.name}: the log has no definition of {kind}: its states are not read")
    if options.joint_topic is not None:
        chosen = [t for t in topics if t.topic.name == options.joint_topic]
        refuse_if(
            not chosen,
            f"joint topic {options.joint_topic}: not a topic of the log with joint states",
            remedy=f"use one of: {', '.join(t.topic.name for t in topics) or 'none there'}",
        )
        return chosen
    return [t for t in topics if t.topic.type_name != TRAJECTORY] or topics


def main_topic(topics: Sequence[TopicSurvey], loss: LossReport) -> TopicSurvey:
    """Prefer /joint_states, then the JointState topic with most messages, then others; commands come last."""
    chosen = max(
        topics,
        key=lambda t: (
            t.topic.name == "/joint_states",
            not _is_command(t.topic.name),
            t.topic.type_name == JOINT_STATE,
            t.count,
            t.topic.name,
        ),
    )
    others = sorted(t.topic.name for t in topics if t is not chosen)
    if others:
        loss.notes.append(f"joint states are taken from {chosen.topic.name}, not from {', '.join(others)}")
    return chosen


def track_of_topic(topic: TopicSurvey, loss: LossReport) -> RawTrack:
    """States with the most joints; others are noted."""
    chosen = max(_tracks([topic]), key=lambda track: (len(track.names), len(track), sorted(track.names)))
    others = topic.joints.num - len(chosen)
    if others:
        loss.notes.append(f"{chosen.where}: {others} of {topic.joints.num} states name other joints: left out")
    return _check_clock(chosen, loss)


def track_of_joints(topics: Sequence[TopicSurvey], joints: Sequence[str], loss: LossReport) -> RawTrack:
    """Merge the states of `joints` from as few topics as possible.

    The topic with most of them gives the stamps; ties prefer end-effector poses, then /joint_states. Joints of other
    topics are interpolated. States outside those topics' times, or in their gaps over `STATES_BRIDGED` with motion,
    are left out with a note.
    """
    tracks = _rename_joints(_tracks(topics), joints, loss)
    base = _base(tracks, joints)
    track = _check_clock(base, loss)
    missing = [name for name in joints if name not in base.names]
    used = [base.where]
    while missing:
        best = max(tracks, key=lambda t: (len(set(t.names) & set(missing)), len(t), t.where))
        added = tuple(name for name in missing if name in best.names)
        if not added:
            break
        track = _fill_joints(track, _check_clock(best, loss).select_names(added), loss)
        missing = [name for name in missing if name not in added]
        used.append(best.where)
    others = sorted({t.topic.name for t in topics} - set(used))
    if others:
        loss.notes.append(
            f"joint states are taken from {', '.join(dict.fromkeys(used))}, not from {', '.join(others)}"
        )
    return track if missing else track.select_names(joints)


def _tracks(topics: Sequence[TopicSurvey]) -> list[RawTrack]:
    tracks = []
    for topic in topics:
        for stream in topic.joints.streams.values():
            names, columns = stream.names, stream.columns()
            if "velocity" not in columns:
                columns["velocity"] = absent(len(stream), len(names))
            stamp_ns, log_ns, where = stream.stamp_ns, stream.log_time_ns, topic.topic.name
            tracks.append(RawTrack(where=where, names=names, stamp_ns=stamp_ns, log_ns=log_ns, **columns))
    return tracks


def _base(tracks: Sequence[RawTrack], joints: Sequence[str]) -> RawTrack:
    return max(
        tracks,
        key=lambda track: (
            len(set(track.names) & set(joints)),
            track.T_base_ee is not None,
            track.where == "/joint_states",
            not _is_command(track.where),
            len(track),
            track.where,
        ),
    )


def _is_command(topic: str) -> bool:
    return any(word in topic.lower() for word in _COMMANDS)


def refuse_contradiction(topics: Sequence[TopicSurvey], joints: Sequence[str] | None) -> None:
    """Raise if the states of `joints` (None: all) come from two robots.

    InputError if another topic, not of commands, has the joints over `STATES_RIVAL` away (median); NotEvaluableError
    if two publishers take turns on one topic.
    """
    tracks = _tracks(topics)
    if joints is None:
        base = max(tracks, key=lambda t: (t.where == main_topic(topics, LossReport()).topic.name, len(t.names)))
    else:
        tracks = _rename_joints(tracks, joints, LossReport())
        base = _base(tracks, joints)
    names = base.names if joints is None else tuple(name for name in base.names if name in joints)
    for other in tracks:
        shared = [name for name in names if name in other.names]
        if other.where == base.where or not shared or _is_command(other.where):
            continue
        apart = _apart(base, other, shared)
        if apart > STATES_RIVAL:
            both = f"{base.where} and {other.where}"
            raise InputError(
                f"joint states: {both} both have {', '.join(shared[:3])} and differ by {apart:.3g} (median)",
                remedy=f"give --joint-topic {base.where} or --joint-topic {other.where}",
            )
    num = _num_turns(base, names)
    refuse_if(
        num >= max(TURNS_FEWEST, TURNS_SHARE * len(base)),
        f"{base.where}: two publishers take turns: {num} of {len(base)} states jump away and back at once",
        remedy="let one node publish the topic (ros2 topic info -v names them), and record again",
        error=NotEvaluableError,
    )


def _apart(base: RawTrack, other: RawTrack, shared: Sequence[str]) -> float:
    stamps, its = base.stamp_ns, other.stamp_ns
    at, at_other = np.argsort(stamps, kind="stable"), np.argsort(its, kind="stable")
    its = its[at_other]
    some = np.unique(np.linspace(0, len(its) - 1, min(len(its), STATES_COMPARED // 10)).astype(np.int64))
    near = np.clip(np.searchsorted(stamps[at], its[some]), 0, len(at) - 1)
    is_near = np.abs(stamps[at][near] - its[some]) <= STATES_BRIDGED * 1e9
    if not is_near.any():
        return 0.0
    one = base.position[at[near[is_near]]][:, [base.names.index(name) for name in shared]]
    two = other.position[at_other[some[is_near]]][:, [other.names.index(name) for name in shared]]
    turned = np.abs(one - two)
    return float(np.median(np.minimum(turned, np.abs(turned - 2 * np.pi)).max(axis=1)))


def _num_turns(track: RawTrack, names: Sequence[str]) -> int:
    columns = [track.names.index(name) for name in names]
    num, order = 0, np.argsort(track.stamp_ns, kind="stable")
    seconds = track.stamp_ns[order] * 1e-9
    for first, last in ranges(max(len(order) - 2, 0)) if columns else ():
        q, gaps = track.position[order[first : last + 2]][:, columns], np.diff(seconds[first : last + 2])
        steps = np.abs(np.diff(q, axis=0))
        jump = np.minimum(steps[1:], steps[:-1])
        fastest = np.maximum(TURNS_ACCELERATION * gaps[1:] * gaps[:-1], TURNS_LEAST)[:, None]
        is_turn = (np.abs(q[2:] - q[:-2]) < 0.25 * jump) & (jump > fastest)
        num += int((is_turn & (np.abs(jump - 2 * np.pi) > 0.1 * np.pi)).any(axis=1).sum())
    return num


def _rename_joints(tracks: list[RawTrack], joints: Sequence[str], loss: LossReport) -> list[RawTrack]:
    logged = dict.fromkeys(name for track in tracks for name in track.names)
    unknown, missing = [n for n in logged if n not in joints], [name for name in joints if name not in logged]
    names = match_prefix(unknown, missing)
    if not names:
        return tracks
    name, joint = next(iter(names.items()))
    loss.notes.append(f"joint names differ by a prefix: {name} is {joint}, and so on")
    return [replace(t, names=tuple(names.get(name, name) for name in t.names)) for t in tracks]


def match_prefix(logged: Sequence[str], joints: Sequence[str]) -> dict[str, str]:
    """Map a log's joint names to a robot's by the commonest prefix; empty if unclear."""
    by_prefix: dict[tuple[str, bool], dict[str, str]] = {}
    for name in dict.fromkeys(logged):
        for joint in joints:
            longer, shorter = (name, joint) if len(name) > len(joint) else (joint, name)
            prefix = longer.removesuffix(shorter)
            if len(prefix) < len(longer) and prefix.endswith(("_", "/", ".", ":", "-")):
                by_prefix.setdefault((prefix, longer == name), {})[name] = joint
    fitting = sorted(by_prefix.values(), key=len)[-2:]
    is_sure = bool(fitting) and len(fitting[-1]) > 1 and (len(fitting) == 1 or len(fitting[0]) < len(fitting[1]))
    return fitting[-1] if is_sure else {}


def _check_clock(track: RawTrack, loss: LossReport) -> RawTrack:
    return replace(track, stamp_ns=checked_stamps(track.stamp_ns, track.log_ns, track.where, loss))


def _fill_joints(track: RawTrack, other: RawTrack, loss: LossReport) -> RawTrack:
    order = np.argsort(other.stamp_ns, kind="stable")
    at = other.stamp_ns[order]
    stamps = track.stamp_ns
    after = np.clip(np.searchsorted(at, stamps), 1, max(len(at) - 1, 1))
    if len(at) == 1:
        at, order = np.repeat(at, 2), np.repeat(order, 2)
    before = after - 1
    position = unwrap(other.select(order), loss).position
    gap = (at[after] - at[before]) * 1e-9
    keep = (stamps >= at[0]) & (stamps <= at[-1]) & ((gap <= STATES_BRIDGED) | _is_still(position, before, after))
    share = np.clip((stamps - at[before]) / np.maximum(at[after] - at[before], 1), 0.0, 1.0)[:, None]

    names = ", ".join(other.names)
    refuse_if(
        not keep.any(),
        f"{track.where} and {other.where}: mixed clocks: at no state of {track.where} is {names} known",
        remedy="give another --joint-topic, or record both by one clock",
    )
    loss.notes.append(f"{track.where}: {names} of {other.where} are interpolated at its {len(stamps)} states")
    if not keep.all():
        lost = f"{int((~keep).sum())} of {len(stamps)} states left out"
        loss.notes.append(f"{track.where}: {lost}: {names} of {other.where} are unknown then")

    def joined(one: Table, two: Table, order: Index) -> Table:
        file = RowFile((len(track.names) + len(other.names),))
        for first, last in ranges(len(stamps)):
            part = slice(first, last)
            between = (1 - share[part]) * two[order[before[part]]] + share[part] * two[order[after[part]]]
            file.append(np.hstack([one[part], between]))
        return Rows(file)

    one, two = track.commanded_velocity, other.commanded_velocity
    return replace(
        track,
        names=(*track.names, *other.names),
        position=joined(track.position, position, np.arange(len(at))),
        velocity=joined(track.velocity, other.velocity, order),
        commanded_velocity=None if one is None or two is None else joined(one, two, order),
    ).select(np.flatnonzero(keep))


def _is_still(table: Table, before: Index, after: Index) -> Bool:
    changes = (table[after[first:last]] - table[before[first:last]] for first, last in ranges(len(before)))
    return np.concatenate([np.zeros(0, np.bool_), *(np.abs(c).max(axis=1) < STATES_STILL for c in changes)])


def checked_stamps(stamp_ns: Stamps, log_ns: Stamps, where: str, loss: LossReport) -> Stamps:
    """Header stamps (T,) [ns] in file order, or log times if no header has one.

    Notes another clock, drift and steps in `loss`. Raises InputError if two clocks are mixed.
    """
    is_unset = stamp_ns == 0
    if is_unset.all():
        loss.notes.append(f"{where}: no state has a stamp; the times of logging are used")
        return log_ns
    refuse_if(
        is_unset.any() and stamp_ns[~is_unset].min() > CLOCK_MIXED * 1e9,
        f"{where}: mixed clocks: {int(is_unset.sum())} of {len(stamp_ns)} states have no stamp",
        remedy="leave them out of the log, or give another --joint-topic",
    )  # a simulation may begin at 0
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
        _refuse_mixed(float(np.ptp(late)), int(np.argmax(np.abs(np.diff(late, append=late[-1:])))) + 1, where)
        return
    near = np.lib.stride_tricks.sliding_window_view(late, n)
    windows = np.concatenate([np.median(near[first:last], axis=1) for first, last in ranges(len(near))])
    change = np.abs(windows[n:] - windows[:-n])  # the n states before i + n against those from it on
    step = float(change.max(initial=0.0))
    if step <= CLOCK_STEP:
        return
    at = int(np.argmax(change))
    state = at + 1 + int(np.argmax(np.abs(np.diff(late[at : at + 2 * n]))))
    _refuse_mixed(step, state, where)
    loss.notes.append(f"{where}: stamps step by {step:.3f} s against the time of logging at state {state}")


def _refuse_mixed(step: float, state: int, where: str) -> None:
    refuse_if(
        step > CLOCK_MIXED,
        f"{where}: mixed clocks: stamps jump by {step:.1f} s against the time of logging at state {state}",
        remedy="cut the log there, or give another --joint-topic",
    )


def _drift(late: Float64, seconds: Float64) -> tuple[float, float]:
    """Growth [s] of the log delay from first to last quarter, and the seconds between.

    Compares the quarters' tenth percentiles, as a message may be logged late. The growth is 0 if the delay jumps.
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
