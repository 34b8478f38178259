"""Criteria of a replay's verdict: what a controller did, ours or the user's own."""

from collections.abc import Iterator

import numpy as np

from splatctrl_cli.config.fixed import LIMIT_EXCEEDED
from splatctrl_cli.control.events import EventKind
from splatctrl_cli.control.replay import Outcome as LoopOutcome
from splatctrl_cli.evaluate.verdict import Outcome, Reason, counted, failed, held
from splatctrl_cli.jobs.replay.criteria_input import CONTACT, CONTROL, LIMITS, Judged, events_of, seconds_at
from splatctrl_cli.jobs.replay.result import OutsideRun


def controller(judged: Judged) -> Iterator[Reason]:
    """Closed loop: every step is solved; a controller of one's own answers every time, and as it should."""
    if judged.replay.outside is not None:
        yield _answers(judged, judged.replay.outside)
        return
    trace, metrics = judged.replay.closed_loop, judged.metrics
    if trace is None:
        return
    bad = {name: metrics[f"num_{name}"] or 0 for name in ("relaxed", "minimum_violation", "hold")}
    if not sum(bad.values()):
        yield held(f"all {len(trace.steps)} steps solved", 0.0, 0.0, "", len(trace.steps))
        return
    kinds = (EventKind.RELAXED, EventKind.MINIMUM_VIOLATION, EventKind.HOLD)
    first = min((e for kind in kinds for e in events_of(judged.replay, kind)), key=lambda e: e.first_ns)
    found = ", ".join(f"{int(count)} {name.replace('_', ' ')}" for name, count in bad.items() if count)
    yield failed(
        sentence=f"its rows could not be kept at {found} of {len(trace.steps)} steps, first",
        value=float(sum(bad.values())),
        threshold=0.0,
        time_s=first.start_s,
        who=first.worst_name,
        cause="" if first.obstacle is None else f"near {first.obstacle}",
        count=len(trace.steps),
        label=CONTROL,
    )


def _answers(judged: Judged, outside: OutsideRun) -> Reason:
    """Whether a controller of one's own did what it should."""
    num, failure = outside.num_answers, outside.failure
    if failure is None:
        return held(f"all {num} steps answered", 0.0, 0.0, "", num)
    return failed(
        sentence=f"{failure.fault}: {failure.sentence}; after {counted(num, 'answer')},",
        value=1.0,
        threshold=0.0,
        time_s=float(failure.stamp_ns - judged.replay.audit.stamp_ns[0]) * 1e-9,
        count=num + 1,
        label=CONTROL,
    )


def scene_hits(judged: Judged) -> Iterator[Reason]:
    """Closed loop: nothing appears inside the arm."""
    trace = judged.replay.closed_loop
    if trace is None:
        return
    hits = judged.metrics["num_scene_hits"] or 0
    if hits:
        change = next(change for change in trace.scene_changes if change.is_hit)
        yield failed(
            sentence=f"the scene came into the arm {int(hits)} times, first",
            value=float(hits),
            threshold=0.0,
            time_s=float(change.stamp_ns - judged.replay.audit.stamp_ns[0]) * 1e-9,
            count=len(trace.scene_changes),
            label=CONTACT,
        )


def goal(judged: Judged) -> Iterator[Reason]:
    """Closed loop: the goal is reached."""
    trace, request = judged.replay.closed_loop, judged.request
    if trace is None or request.follow or request.twist_topic is not None:
        return
    reached = trace.outcome is LoopOutcome.GOAL_REACHED
    has_way = trace.outcome not in (LoopOutcome.GOAL_REACHED, LoopOutcome.CONTROLLER_FAILED)
    yield Reason(
        outcome=Outcome.PASSED if reached else Outcome.FAILED,
        sentence="reached" if reached else f"not reached: {trace.outcome}",
        value=float(reached),
        threshold=1.0,
        count=len(trace.steps),
        label="goal not reached",
        remedy="--set control.max_detours=3 lets the planner find a way round" if has_way else "",
    )


def commanded(judged: Judged) -> Reason | None:
    """Where a controller of one's own commands more than the limits; None where it does not."""
    replay = judged.replay
    if replay.outside is None or replay.kept_steps is None:
        return None
    shares = np.abs(np.asarray(replay.kept_steps.velocity)) / replay.model.velocity_limit
    if not np.nanmax(shares, initial=0.0) > LIMIT_EXCEEDED:
        return None
    state, joint = np.unravel_index(np.nanargmax(shares), shares.shape)
    name, most = replay.model.joint_names[joint], float(shares[state, joint])
    return failed(
        sentence=f"{name} is commanded {most:.2f} times its limit",
        value=most,
        threshold=1.0,
        time_s=seconds_at(judged, int(state)),
        who=name,
        count=judged.num_states,
        label=LIMITS,
    )
