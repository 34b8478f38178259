"""Two clocks of one log: what stamped the messages, and what logged them."""

import numpy as np

from splatctrl_cli.config.fixed import CLOCK_DRIFT, CLOCK_MIXED, CLOCK_NEIGHBOURS, CLOCK_OTHER, CLOCK_STEP
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.spilled_rows import ranges
from splatctrl_cli.records import Float64, LossReport, Stamps


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
