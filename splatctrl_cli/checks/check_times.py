"""Timing of topics: rate, gaps, repeated or decreasing stamps, clocks."""

import heapq
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from splatctrl_cli.checks import limits
from splatctrl_cli.checks.finding import ERROR, NOTE, WARNING, Finding, Rate, judge, warning
from splatctrl_cli.records import Float64

_NS = 1e-9


T = TypeVar("T")


class Thinned(list[T]):
    """Every k-th of a series; k doubles beyond `limit` values."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._limit, self._step, self._num = limit, 1, 0

    def is_next(self) -> bool:
        """True if the next value is kept; call once per value, before `add`."""
        is_kept = self._num % self._step == 0
        self._num += 1
        return is_kept

    def add(self, value: T) -> None:
        self.append(value)
        if len(self) > self._limit:
            del self[1::2]
            self._step *= 2


class TimesWatch:
    """Bounded timing of one topic, by header stamps, else log times."""

    def __init__(self, topic: str, *, has_stamps: bool) -> None:
        self.topic, self.has_stamps = topic, has_stamps
        self.count = self.num_duplicates = self.num_back = self.num_zero = 0
        self.first_ns = self.last_ns = 0
        self.first_duplicate_ns = self.first_back_ns = 0
        self.furthest_back = 0.0
        self._intervals: Thinned[float] = Thinned(limits.KEPT_INTERVALS)
        self._delays: Thinned[tuple[float, float]] = Thinned(limits.KEPT_INTERVALS)
        self._longest: list[tuple[int, int]] = []
        self._latest_ns = 0

    def add(self, stamp_ns: int, log_ns: int) -> None:
        self.count += 1
        self.num_zero += self.has_stamps and stamp_ns == 0
        interval = stamp_ns - self._latest_ns
        if self.count == 1:
            self.first_ns = self.last_ns = stamp_ns
        elif interval == 0:
            self.num_duplicates += 1
            self.first_duplicate_ns = self.first_duplicate_ns or stamp_ns
        elif interval < 0:
            self.num_back += 1
            self.first_back_ns = self.first_back_ns or stamp_ns
            self.furthest_back = max(self.furthest_back, -interval * _NS)
        else:
            if self._intervals.is_next():
                self._intervals.add(interval * _NS)
            heapq.heappush(self._longest, (interval, self._latest_ns))
            if len(self._longest) > limits.KEPT_GAPS:
                heapq.heappop(self._longest)
        if self.has_stamps and self._delays.is_next():
            self._delays.add((log_ns * _NS, (log_ns - stamp_ns) * _NS))
        self.first_ns, self.last_ns = min(self.first_ns, stamp_ns), max(self.last_ns, stamp_ns)
        self._latest_ns = stamp_ns

    @property
    def median_interval(self) -> float | None:
        """Median interval [s]; None for fewer than two different times."""
        return float(np.median(self._intervals)) if self._intervals else None

    @property
    def delays(self) -> Float64:
        """Rows (K, 2) [s]: log time, log time minus stamp."""
        return np.array(self._delays, dtype=np.float64).reshape(-1, 2)

    @property
    def delay(self) -> float | None:
        """Median log time minus stamp [s]."""
        return float(np.median(self.delays[:, 1])) if self._delays and not self.num_zero else None

    def gaps(self) -> list[tuple[float, int]]:
        """Intervals [s] far above the median, with the stamp before each; none without a steady rate."""
        median = self.median_interval
        if median is None or float(np.quantile(self._intervals, 0.9)) > limits.REGULAR * median:
            return []  # no steady rate
        limit = max(limits.GAP_SECONDS, limits.GAP_RATIO * median)
        return sorted(((i * _NS, at) for i, at in self._longest if i * _NS > limit), key=lambda gap: gap[1])

    def rate(self, *, is_read: bool) -> Rate:
        median = self.median_interval
        return Rate(
            topic=self.topic,
            is_read=is_read,
            messages=self.count,
            hz=None if not median else 1.0 / median,
            longest_s=max(self._longest)[0] * _NS if self._longest else None,
            delay_s=self.delay,
        )


def time_findings(times: TimesWatch, what: str = "messages") -> list[Finding]:
    where, count = times.topic, times.count
    if times.num_zero:
        text = f"{times.num_zero} of {count} header stamps are 0"
        text = f"{text}; the times of logging are taken where all are" if what == "states" else text
        severity = ERROR if times.num_zero == count and what != "states" else WARNING
        return judge(severity, "stamp-zero", where, text, value=times.num_zero)
    gaps, median = times.gaps(), times.median_interval or 1.0
    longest, at = max(gaps, default=(0.0, 0))
    lost = sum(round(interval / median) - 1 for interval, _ in gaps)
    gaps_of = f"a gap of {longest:.3g} s" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest {longest:.3g} s"
    return [
        *judge(
            WARNING if gaps else None,
            "gap",
            where,
            f"{gaps_of}; about {lost} {what} are missing",
            value=longest,
            unit="s",
            stamp_ns=at,
        ),
        *judge(
            WARNING if times.num_duplicates else None,
            "stamp-repeats",
            where,
            f"{times.num_duplicates} of {count} stamps repeat the one before",
            value=times.num_duplicates,
            stamp_ns=times.first_duplicate_ns,
        ),
        *judge(
            WARNING if times.num_back else None,
            "stamp-back",
            where,
            f"stamps go back {times.num_back} times, by up to {times.furthest_back:.3g} s",
            value=times.furthest_back,
            unit="s",
            stamp_ns=times.first_back_ns,
        ),
    ]


def join_gaps(findings: list[Finding]) -> list[Finding]:
    """Findings, with common pauses of topics and transforms joined."""
    others = [f for f in findings if f.code not in {"gap", "tf-gap"}]
    groups: list[list[Finding]] = []
    for finding in (f for f in findings if f.code in {"gap", "tf-gap"}):
        group = next((g for g in groups if _overlap(g[0], finding)), [])
        groups += [] if group else [group]
        group.append(finding)
    return [*(group[0] if len(group) == 1 else _joined(group) for group in groups), *others]


def _overlap(a: Finding, b: Finding) -> bool:
    (a0, a1), (b0, b1) = (((f.stamp_ns or 0) * _NS, (f.stamp_ns or 0) * _NS + (f.value or 0.0)) for f in (a, b))
    return min(a1, b1) - max(a0, b0) > limits.PAUSED_TOGETHER * min(a1 - a0, b1 - b0)


def _joined(group: list[Finding]) -> Finding:
    worst = max(group, key=lambda f: f.value or 0.0)
    names = [f.where for f in group]
    return replace(
        worst,
        where=", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else ""),
        what=f"{len(names)} pause together; of {worst.where}: {worst.what}",
    )


def file_findings(spans: Mapping[str, tuple[int, int]]) -> list[Finding]:
    """Files logged far apart; spans: first and last log time [ns]."""
    ordered = sorted((span, name) for name, span in spans.items() if name)
    pauses = [((after[0] - before[1]) * _NS, before[1], a, b) for (before, a), (after, b) in pairwise(ordered)]
    return [
        warning(
            "files-apart",
            "files",
            f"between {name} and {other} nothing was logged for {pause:.4g} s",
            value=pause,
            unit="s",
            stamp_ns=at,
        )
        for pause, at, name, other in pauses
        if pause > limits.FILES_APART
    ]


def ending_findings(edges: list[TimesWatch], last_ns: int) -> list[Finding]:
    """Moving transforms that end long before the last image."""
    early_s = limits.ENDS_EARLY
    ended = [
        e for e in edges if e.count > 2 and (last_ns - e.last_ns) * _NS > max(early_s, 3 * (e.median_interval or 0))
    ]
    if not ended:
        return []
    first = min(ended, key=lambda edge: edge.last_ns)
    early, more = (last_ns - first.last_ns) * _NS, f" and {len(ended) - 1} more" if len(ended) > 1 else ""
    text = f"ends {early:.3g} s before the last image: frames below it have no pose from then on"
    return [warning("tf-ends", f"{first.topic}{more}", text, value=early, unit="s", stamp_ns=first.last_ns)]


def part_findings(topics: list[TimesWatch]) -> Iterator[Finding]:
    """Topics that start long after others, or end long before."""
    several = [t for t in topics if t.count > 2 and t.median_interval is not None]
    first, last = (min((t.first_ns for t in several), default=0), max((t.last_ns for t in several), default=0))
    for times in several:
        least, much = (
            max(limits.ENDS_EARLY, 3 * (times.median_interval or 0.0)),
            limits.ENDS_MUCH * (last - first) * _NS,
        )
        begins, ends = (times.first_ns - first) * _NS, (last - times.last_ns) * _NS
        for seconds, words, side, at in (
            (begins, "begins", "after the first", times.first_ns),
            (ends, "ends", "before the last", times.last_ns),
        ):
            severity = None if seconds <= least else WARNING if seconds > much else NOTE
            text = f"{words} {seconds:.3g} s {side} of the other topics"
            yield from judge(severity, "part", times.topic, text, value=seconds, unit="s", stamp_ns=at)


def peer_findings(topics: list[TimesWatch]) -> Iterator[Finding]:
    """Topics whose log delay differs from the other cameras'."""
    stamped = [t for t in topics if t.delay is not None and t.count > 1]
    for times in stamped if len(stamped) > 2 else ():
        own = times.delays[:, 1]
        others = np.array([t.delay for t in stamped if t is not times], dtype=np.float64)
        apart = float(np.median(own) - np.median(others))
        least = max(limits.PEERS_APART, 5 * float(np.median(np.abs(own - np.median(own)))), 3 * float(np.ptp(others)))
        yield from judge(
            WARNING if least < abs(apart) <= limits.DELAYS_APART else None,
            "clock-offset",
            times.topic,
            f"stamps are {1e3 * abs(apart):.0f} ms {'before' if apart > 0 else 'after'} those of the other"
            " cameras' images, as logged",
            "is its clock synchronised (PTP, chrony), or is its stream only slower? compare what moves",
            value=round(1e3 * apart, 1),
            unit="ms",
            stamp_ns=times.first_ns,
        )


def clock_findings(topics: list[TimesWatch]) -> list[Finding]:
    """Findings of header stamps against log times: another clock, offset, drift."""
    stamped = [(t, t.delay) for t in topics if t.delay is not None and t.count > 1]
    if not stamped:
        return []
    common = float(np.median([delay for _, delay in stamped]))
    is_shifted = abs(common) > limits.STAMP_DELAYED and all(
        abs(delay - common) <= limits.DELAYS_APART for _, delay in stamped
    )
    shifted = judge(
        NOTE if is_shifted else None,
        "clock",
        "all topics",
        f"header stamps are of another clock than the log's, {common:+.4g} s apart, the same for all topics"
        " (a played log, or simulated time)",
        value=common,
        unit="s",
    )
    offsets = [] if is_shifted else [f for times, delay in stamped for f in _offset(times, delay, common)]
    return [*shifted, *offsets, *(f for times, _ in stamped for f in _drift(times))]


def _offset(times: TimesWatch, delay: float, common: float) -> list[Finding]:
    text = f"header stamps are {delay:.4g} s before the log's times"
    if -delay > limits.STAMP_AHEAD:
        text = f"header stamps are {-delay:.3g} s later than the log's times: the sender's clock is ahead"
    elif delay <= limits.STAMP_DELAYED:
        text = f"header stamps are {delay:.3g} s before the log's times, those of most topics {common:.3g} s"
    is_off = not -limits.STAMP_AHEAD <= delay <= limits.STAMP_DELAYED or abs(delay - common) > limits.DELAYS_APART
    return judge(
        WARNING if is_off else None,
        "clock-offset",
        times.topic,
        text,
        "synchronise the clocks (chrony, PTP) and record again; images and poses do not belong together",
        value=delay,
        unit="s",
        stamp_ns=times.first_ns,
    )


def _drift(times: TimesWatch) -> list[Finding]:
    rows = times.delays
    at, delay = rows[:, 0] - rows[:1, 0], rows[:, 1]
    if len(rows) < 20 or at[-1] <= 0:
        return []
    slope = _slope(at, delay)
    spread = float(np.median(np.abs(delay - np.median(delay) - slope * (at - np.median(at)))))
    change = slope * float(at[-1])
    return judge(
        WARNING if abs(change) >= max(limits.DELAYS_DRIFT, 6.0 * spread) else None,
        "clock-drift",
        times.topic,
        f"header stamps drift against the log's times by {1e3 * change:+.0f} ms ({1e6 * slope:+.0f} ppm)",
        value=change,
        unit="s",
        stamp_ns=times.first_ns,
    )


def _slope(at: Float64, delay: Float64) -> float:
    half = len(at) // 2
    rise = delay[-half:] - delay[:half]
    run = at[-half:] - at[:half]
    return float(np.median(rise[run > 0] / run[run > 0])) if (run > 0).any() else 0.0
