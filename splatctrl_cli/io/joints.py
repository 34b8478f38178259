"""Joint states of a log in one joint order."""

from collections import Counter

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.decoder import JOINT_STATE
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.survey import RawJoints, Survey, TopicSurvey
from splatctrl_cli.records import Float64, JointState, LossReport


def joint_records(
    survey: Survey, options: SourceOptions, loss: LossReport
) -> tuple[tuple[str, ...], list[JointState]]:
    """Joint names and states by stamp; no names and no states where the log holds none.

    States that lack a joint of the fullest (a gripper that publishes alone), or hold NaN, are left out with a note.
    Where velocities are not recorded they are the central differences of the positions, with a note.
    """
    topic = _topic(survey, options, loss)
    if topic is None:
        return (), []
    sets = Counter(frozenset(joints.names) for joints in topic.joints)
    chosen = max(sets, key=lambda names: (len(names), sets[names], sorted(names)))
    names = next(joints.names for joints in topic.joints if frozenset(joints.names) == chosen)
    kept = [joints for joints in topic.joints if chosen == frozenset(joints.names)]
    others = len(topic.joints) - len(kept)
    if others:
        loss.notes.append(f"{topic.topic.name}: {others} of {len(topic.joints)} states name other joints: left out")
    finite = sorted((j for j in kept if _is_finite(j)), key=lambda j: j.stamp_ns)
    if len(finite) < len(kept):
        loss.damaged += len(kept) - len(finite)
        loss.notes.append(f"{topic.topic.name}: {len(kept) - len(finite)} states with NaN or infinity: left out")
    if not finite:
        return (), []
    return names, _states(finite, names, topic.topic.name, loss)


def _topic(survey: Survey, options: SourceOptions, loss: LossReport) -> TopicSurvey | None:
    topics = {t.topic.name: t for t in survey.of_type(JOINT_STATE) if t.joints and any(j.names for j in t.joints)}
    if options.joint_topic is not None:
        if options.joint_topic not in topics:
            raise InputError(
                f"joint topic {options.joint_topic}: not a JointState topic of the log",
                remedy=f"use one of: {', '.join(topics) or 'none there'}",
            )
        return topics[options.joint_topic]
    if not topics:
        return None
    chosen = topics.get("/joint_states") or max(topics.values(), key=lambda t: (t.count, t.topic.name))
    others = sorted(set(topics) - {chosen.topic.name})
    if others:
        loss.notes.append(f"joint states are taken from {chosen.topic.name}, not from {', '.join(others)}")
    return chosen


def _is_finite(joints: RawJoints) -> bool:
    return bool(np.isfinite(joints.position).all() and np.isfinite(joints.velocity).all())


def _states(states: list[RawJoints], names: tuple[str, ...], topic: str, loss: LossReport) -> list[JointState]:
    order = [[state.names.index(name) for name in names] for state in states]
    positions = np.array([state.position[o] for state, o in zip(states, order, strict=True)])
    if all(len(state.velocity) == len(names) for state in states):
        velocities = np.array([state.velocity[o] for state, o in zip(states, order, strict=True)])
    else:
        loss.notes.append(f"{topic}: no velocities recorded; they are differences of the positions")
        velocities = _differences(np.array([state.stamp_ns for state in states]), positions)
    return [
        JointState(stamp_ns=state.stamp_ns, position=position, velocity=velocity)
        for state, position, velocity in zip(states, positions, velocities, strict=True)
    ]


def _differences(stamps_ns: np.ndarray[tuple[int], np.dtype[np.int64]], positions: Float64) -> Float64:
    """Central differences [1/s] of positions (T, J); zero between equal stamps."""
    velocities = np.zeros_like(positions)
    last = len(positions) - 1
    for i in range(len(positions)):
        before, after = max(i - 1, 0), min(i + 1, last)
        span = (stamps_ns[after] - stamps_ns[before]) * 1e-9
        if span > 0:
            velocities[i] = (positions[after] - positions[before]) / span
    return velocities
