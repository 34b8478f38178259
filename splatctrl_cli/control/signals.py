"""What there is to say of the states of a replay, as signals that make events: clearances, limits, the controller."""

from collections.abc import Callable, Sequence

import numpy as np

from splatctrl_cli.control.audit import AuditTrace
from splatctrl_cli.control.events import EventKind, OneEach, Signal
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.limits import Strain
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import Bool, Float64, Index


def audit_signals(
    audit: AuditTrace, margin: float, spheres: Sequence[str], joints: Sequence[str], pairs: Sequence[str] = ()
) -> list[Signal]:
    """What the clearances, limits and known space of T states amount to; pairs: names of what may
    collide with each other.
    """
    signals = []
    for source, clearance in audit.clearance.items():
        signals += clearance_signals(source, clearance.distance, clearance.sphere, margin, spheres)
        is_blank = np.isnan(clearance.distance)
        names = OneEach(names=spheres, index=clearance.sphere)
        signals.append(
            Signal(
                kind=EventKind.WITHOUT_DISTANCE,
                is_on=is_blank,
                value=is_blank.astype(np.float64),
                names_at=names,
                source=source,
            )
        )
    unknown = np.nan_to_num(audit.unknown_share)
    signals.append(Signal(kind=EventKind.UNKNOWN_SPACE, is_on=unknown > 0, value=unknown, names_at=_nobody))
    outside = audit.limit_margin
    signals.append(
        _low(EventKind.OUTSIDE_LIMITS, outside < 0, outside, OneEach(names=joints, index=audit.limit_joint))
    )
    touching = audit.self_clearance
    signals.append(
        _low(EventKind.SELF_COLLISION, touching < 0, touching, OneEach(names=pairs, index=audit.self_pair))
    )
    return signals


def clearance_signals(
    source: str, distance: Float64, sphere: Index, margin: float, spheres: Sequence[str]
) -> list[Signal]:
    """Below the margin, and in contact, by the clearance (T,) [m] of the sphere (T,) that is nearest."""
    names = OneEach(names=spheres, index=sphere)
    return [
        _low(kind, distance < bound, distance, names, source)
        for kind, bound in ((EventKind.BELOW_MARGIN, margin), (EventKind.IN_COLLISION, 0.0))
    ]


def limit_signals(strain: Strain, joints: Sequence[str]) -> list[Signal]:
    """Where a motion is faster, or changes more suddenly, than its joints may."""
    return [
        Signal(kind=kind, is_on=value > 1, value=value, names_at=OneEach(names=joints, index=joint))
        for kind, value, joint in (
            (EventKind.TOO_FAST, strain.velocity, strain.velocity_joint),
            (EventKind.TOO_SUDDEN, strain.acceleration, strain.acceleration_joint),
        )
    ]


def interval_signals(lower: Float64, unbounded: Float64, margin: float) -> list[Signal]:
    """Since the state before each of T: a clearance bound (T,) [m] below the margin, and time (T,) [s] unbounded."""
    is_low = lower < margin
    return [
        _low(EventKind.BETWEEN_STATES, is_low, lower, _nobody),
        Signal(kind=EventKind.NOT_BOUNDED, is_on=unbounded > 0, value=unbounded, names_at=_nobody),
    ]


def stale_signal(age_s: Float64, max_age_s: float) -> Signal:
    """Where the scene in use is older than allowed; age_s (T,) [s], NaN where a scene has no time."""
    return Signal(kind=EventKind.STALE_MAP, is_on=age_s > max_age_s, value=np.nan_to_num(age_s), names_at=_nobody)


def step_signals(steps: Sequence[ControlStep | None]) -> list[Signal]:
    """What the controller did at T states; None where it was not asked."""

    def relaxed(i: int) -> Sequence[str]:
        return [row.name for row in sorted(_asked(steps, i).relaxed, key=lambda row: -row.slack)]

    signals = [_intervention_signal(steps, kind) for kind in RowKind]
    slack = _of(steps, lambda step: max((row.slack for row in step.relaxed), default=0.0))
    is_outside = _of(steps, lambda step: float(step.rung is Rung.OUTSIDE)) > 0
    for kind, is_on in (
        (EventKind.RELAXED, (slack > 0) & ~is_outside),
        (EventKind.ROW_BROKEN, (slack > 0) & is_outside),
    ):
        signals.append(Signal(kind=kind, is_on=is_on, value=slack, names_at=relaxed))
    residual, clearance = _of(steps, lambda step: step.residual), _of(steps, lambda step: step.clearance)
    is_least = _of(steps, lambda step: float(step.rung is Rung.MINIMUM_VIOLATION)) > 0
    is_hold = _of(steps, lambda step: float(step.rung is Rung.HOLD)) > 0
    scale = _of(steps, lambda step: step.scale, otherwise=1.0)
    cannot = _of(steps, lambda step: float(len(step.violated_fixed))) > 0
    fixed = _of(steps, lambda step: step.fixed_distance)

    def nearest(i: int) -> Sequence[str]:
        return [_asked(steps, i).nearest]

    signals += [
        Signal(kind=EventKind.MINIMUM_VIOLATION, is_on=is_least, value=residual, names_at=nearest),
        _low(EventKind.HOLD, is_hold, clearance, nearest),
        _low(EventKind.SCALED_BACK, (scale < 1) & ~is_hold, scale, nearest),
        _low(EventKind.CANNOT_ACT, cannot, fixed, lambda i: _asked(steps, i).violated_fixed),
    ]
    return signals


def _intervention_signal(steps: Sequence[ControlStep | None], kind: RowKind) -> Signal:
    def largest(step: ControlStep) -> float:
        return max((row.multiplier for row in step.interventions if row.kind is kind), default=0.0)

    def names_at(index: int) -> Sequence[str]:
        rows = [row for row in _asked(steps, index).interventions if row.kind is kind]
        return [row.name for row in sorted(rows, key=lambda row: -row.multiplier)]

    value = _of(steps, largest)
    return Signal(kind=EventKind(kind.value), is_on=value > 0, value=value, names_at=names_at)


def _low(
    kind: EventKind, is_on: Bool, value: Float64, names_at: Callable[[int], Sequence[str]], source: str = ""
) -> Signal:
    return Signal(kind=kind, is_on=is_on, value=value, names_at=names_at, is_high_worse=False, source=source)


def _of(
    steps: Sequence[ControlStep | None], value: Callable[[ControlStep], float], otherwise: float = 0.0
) -> Float64:
    return np.array([otherwise if step is None else value(step) for step in steps], dtype=np.float64)


def _asked(steps: Sequence[ControlStep | None], index: int) -> ControlStep:
    step = steps[index]
    assert step is not None
    return step


def _nobody(_: int) -> Sequence[str]:
    return ()
