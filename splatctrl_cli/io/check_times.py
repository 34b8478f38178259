"""When the messages of a topic came: rate, gaps, stamps that repeat or go back, header stamps against log times."""

import heapq
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.io.finding import Finding, Thinned, error, note, warning
from splatctrl_cli.records import Float64

MAX_KEPT = 4096  # intervals and delays of a topic, however long the log
MAX_GAPS = 1000  # the longest intervals
GAP_RATIO = 3.0  # of the median interval
MIN_GAP = 0.1  # [s]; a shorter gap costs nothing
REGULAR = 2.0  # times the median that nine of ten intervals must stay under for a topic to have a rate
AHEAD = 0.020  # [s] that a stamp may be after its log time
DELAYED = 1.0  # [s] from stamp to log that no driver takes
APART = 0.2  # [s] between the delays of two topics
DRIFT = 0.020  # [s] over the log
_NS = 1e-9


@dataclass(frozen=True, kw_only=True)
class Rate:
    """A row of the table of rates; is_read: by later commands; hz: median; longest_s: interval between two stamps;
    delay_s: median of log time minus stamp.
    """

    topic: str
    is_read: bool
    messages: int
    hz: float | None
    longest_s: float | None
    delay_s: float | None


class TimesWatch:
    """Watches one topic in bounded memory; stamps are those of headers where messages have one, else log times."""

    def __init__(self, topic: str, *, has_stamps: bool) -> None:
        self.topic, self.has_stamps = topic, has_stamps
        self.count = self.num_duplicates = self.num_back = self.num_zero = 0
        self.first_ns = self.last_ns = 0
        self.first_duplicate_ns = self.first_back_ns = 0
        self.furthest_back = 0.0
        self._intervals: Thinned[float] = Thinned(MAX_KEPT)
        self._delays: Thinned[tuple[float, float]] = Thinned(MAX_KEPT)
        self._longest: list[tuple[int, int]] = []
        self._latest_ns = 0

    def add(self, stamp_ns: int, log_ns: int) -> None:
        """The next message of the file."""
        self.count += 1
        self.num_zero += self.has_stamps and stamp_ns == 0
        if self.count == 1:
            self.first_ns = self.last_ns = self._latest_ns = stamp_ns
        else:
            self._step(stamp_ns)
        if self.has_stamps and self._delays.is_next():
            self._delays.add((log_ns * _NS, (log_ns - stamp_ns) * _NS))
        self.first_ns, self.last_ns = min(self.first_ns, stamp_ns), max(self.last_ns, stamp_ns)
        self._latest_ns = stamp_ns

    def _step(self, stamp_ns: int) -> None:
        interval = stamp_ns - self._latest_ns
        if interval == 0:
            self.num_duplicates += 1
            self.first_duplicate_ns = self.first_duplicate_ns or stamp_ns
        elif interval < 0:
            self.num_back += 1
            self.first_back_ns = self.first_back_ns or stamp_ns
            self.furthest_back = max(self.furthest_back, -interval * _NS)
        else:
            if self._intervals.is_next():
                self._intervals.add(interval * _NS)
            entry = (interval, self._latest_ns)
            if len(self._longest) < MAX_GAPS:
                heapq.heappush(self._longest, entry)
            else:
                heapq.heappushpop(self._longest, entry)

    @property
    def median_interval(self) -> float | None:
        """[s]; None for less than two messages of different times."""
        return float(np.median(list(self._intervals))) if len(self._intervals) else None

    @property
    def is_regular(self) -> bool:
        """Whether the messages have a rate at all."""
        median = self.median_interval
        return median is not None and float(np.quantile(list(self._intervals), 0.9)) <= REGULAR * median

    @property
    def delays(self) -> Float64:
        """Rows (K, 2) [s] of log time and log time minus stamp."""
        return np.array(list(self._delays), dtype=np.float64).reshape(-1, 2)

    @property
    def delay(self) -> float | None:
        """Median of log time minus stamp [s]."""
        return float(np.median(self.delays[:, 1])) if len(self._delays) and not self.num_zero else None

    def gaps(self) -> list[tuple[float, int]]:
        """Intervals [s] far above the median, and the stamp before each, by time; none where there is no rate."""
        median = self.median_interval
        if median is None or not self.is_regular:
            return []
        limit = max(MIN_GAP, GAP_RATIO * median)
        return sorted(((i * _NS, at) for i, at in self._longest if i * _NS > limit), key=lambda gap: gap[1])

    def rate(self, *, is_read: bool) -> Rate:
        """Its row of the table."""
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
    """What is wrong with the times of one topic."""
    found: list[Finding] = []
    where = times.topic
    if times.num_zero:
        share = f"{times.num_zero} of {times.count}"
        remedy = "let the driver stamp them; without stamps nothing can be paired or placed"
        found.append(error("stamp-zero", where, f"{share} header stamps are 0", remedy, value=times.num_zero))
        return found
    gaps = times.gaps()
    if gaps and times.median_interval is not None:
        longest, at = max(gaps)
        lost = sum(round(interval / times.median_interval) - 1 for interval, _ in gaps)
        text = f"{len(gaps)} gaps, the longest {longest:.3g} s; about {lost} {what} are missing"
        remedy = "record fewer topics or to a faster disk; what moved meanwhile is unknown"
        found.append(warning("gap", where, text, remedy, value=longest, unit="s", stamp_ns=at))
    if times.num_duplicates:
        text = f"{times.num_duplicates} of {times.count} stamps repeat the one before"
        remedy = "look for a driver that publishes twice, or a topic recorded twice"
        first = times.first_duplicate_ns
        found.append(warning("stamp-repeats", where, text, remedy, value=times.num_duplicates, stamp_ns=first))
    if times.num_back:
        text = f"stamps go back {times.num_back} times, by up to {times.furthest_back:.3g} s"
        remedy = "two publishers on one topic, a clock that was set, or a loop of a played log: record again"
        first = times.first_back_ns
        figure = {"value": times.furthest_back, "unit": "s", "stamp_ns": first}
        found.append(warning("stamp-back", where, text, remedy, **figure))
    return found


def clock_findings(topics: list[TimesWatch]) -> list[Finding]:
    """What header stamps say beside log times: another clock, an offset, a drift."""
    stamped = [t for t in topics if t.delay is not None and t.count > 1]
    if not stamped:
        return []
    delays = [t.delay for t in stamped if t.delay is not None]
    common = float(np.median(delays))
    if abs(common) > DELAYED and max(abs(delay - common) for delay in delays) <= APART:
        text = f"header stamps are of another clock than the log's, {common:+.4g} s apart, the same for all topics"
        found = [note("clock", "all topics", f"{text} (a played log, or simulated time)", value=common, unit="s")]
    else:
        found = [*filter(None, (_offset(t, common) for t in stamped))]
    return [*found, *filter(None, (_drift(t) for t in stamped))]


def _offset(times: TimesWatch, common: float) -> Finding | None:
    delay = times.delay
    assert delay is not None
    figure = {"value": delay, "unit": "s", "stamp_ns": times.first_ns}
    if -delay > AHEAD:
        text = f"header stamps are {-delay:.3g} s later than the log's times: the sender's clock is ahead"
    elif delay > DELAYED:
        text = f"header stamps are {delay:.4g} s before the log's times"
    elif abs(delay - common) > APART:
        text = f"header stamps are {delay:.3g} s before the log's times, those of most topics {common:.3g} s"
    else:
        return None
    remedy = "synchronise the clocks (chrony, PTP) and record again; images and poses do not belong together"
    return warning("clock-offset", times.topic, text, remedy, **figure)


def _drift(times: TimesWatch) -> Finding | None:
    rows = times.delays
    if len(rows) < 20:
        return None
    at, delay = rows[:, 0] - rows[0, 0], rows[:, 1]
    if at[-1] <= 0:
        return None
    slope = _slope(at, delay)
    spread = float(np.median(np.abs(delay - np.median(delay) - slope * (at - np.median(at)))))
    change = slope * float(at[-1])
    if abs(change) < max(DRIFT, 6.0 * spread):
        return None
    text = f"header stamps drift against the log's times by {1e3 * change:+.0f} ms ({1e6 * slope:+.0f} ppm)"
    remedy = "synchronise the clocks (chrony, PTP) and record again"
    return warning("clock-drift", times.topic, text, remedy, value=change, unit="s", stamp_ns=times.first_ns)


def _slope(at: Float64, delay: Float64) -> float:
    """Median slope between the first and the second half (a few late messages do not turn it)."""
    half = len(at) // 2
    rise = delay[-half:] - delay[:half]
    run = at[-half:] - at[:half]
    return float(np.median(rise[run > 0] / run[run > 0])) if (run > 0).any() else 0.0
