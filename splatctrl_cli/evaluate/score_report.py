"""What a score concludes from its figures: means over scans, changes since an earlier score, the verdict.

A report is what ``score.json`` holds: ``metrics`` by flat name, ``protocol``, ``warnings``, and ``views``, or
``results`` by scan.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.cloud import CLOUD_SCALES
from splatctrl_cli.evaluate.gates import gate_reasons
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, FAULTS
from splatctrl_cli.evaluate.score import metric_scales
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, noted, verdict_of

PREFIX = "change_"
COMPARED = ("name", "split", "mask_rule", "resolution", "averaging", "lpips", "scans")
SUMS = ("num_views", "num_skipped", "num_warnings", "num_points", "num_reference")
AVERAGING = "mean over the views"
SCALES = {
    **metric_scales(),
    **CLOUD_SCALES,
    "free_mass": BAD_SHARE,
    "num_skipped": DESCRIBES,
    "num_warnings": FAULTS,
    "num_scans": DESCRIBES,
}
NAMES = tuple(SCALES)
NAMES_WITH_CHANGES = (*NAMES, *(PREFIX + name for name in NAMES))  # since a baseline


def read_baseline(path: Path) -> dict[str, Any]:
    """The report of an earlier score. Raises InputError where the file is not a score."""
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(earlier["metrics"], dict) and isinstance(earlier["protocol"], dict):
            return dict(earlier)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError):
        pass
    raise InputError(f"{path}: expected the score.json of an earlier score, got another file")


def changes(report: Mapping[str, Any], path: Path) -> dict[str, float | None]:
    """New less old of each figure, None where either is; raises InputError where they came about differently."""
    earlier = read_baseline(path)
    now, then = ({**one["protocol"], "scans": one.get("scans")} for one in (report, earlier))
    for name in COMPARED:
        if now.get(name) != then.get(name):
            raise InputError(
                f"{path}: not comparable: {name}: expected {now.get(name)}, got {then.get(name)}",
                remedy="score the baseline anew, in the same way",
            )
    changed: dict[str, float | None] = {}
    for name, value in report["metrics"].items():
        old = earlier["metrics"].get(name)
        changed[PREFIX + name] = None if value is None or not isinstance(old, int | float) else value - old
    return changed


def report_of_scans(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The means over the scans of what each scan's `results` hold; a figure that one of them lacks is None."""
    each, scans = list(results.values()), list(results)
    metrics = {
        name: (sum_of if name in SUMS else mean_of)([one["metrics"].get(name) for one in each])
        for name in each[0]["metrics"]
    }
    protocols = [result["protocol"] for result in each]
    warnings = [f"{scan}: {line}" for scan, result in results.items() for line in result["warnings"]]
    return {
        "scans": scans,
        "protocol": _common(protocols) | {"averaging": f"{AVERAGING} of a scan, then over the scans"},
        "metrics": metrics | {"num_scans": len(results)},
        "warnings": [*warnings, *other_scans(protocols[0], scans)],
        "results": dict(results),
    }


def sum_of(values: Sequence[float | None]) -> float | None:
    """None where any is missing."""
    known = [value for value in values if value is not None]
    return sum(known) if len(known) == len(values) else None


def mean_of(values: Sequence[float | None]) -> float | None:
    """None where any is missing."""
    total = sum_of(values)
    return None if total is None else total / len(values)


def _common(protocols: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the scans were scored by: where they differ, each of it."""
    first = protocols[0]
    common = {}
    for name, value in first.items():
        others = list(dict.fromkeys(str(protocol[name]) for protocol in protocols))
        common[name] = value if len(others) == 1 else " | ".join(others)
    sizes = [size for protocol in protocols for size in protocol["resolution"]]
    return common | {"resolution": sorted(set(sizes)), "background": first["background"]}


def other_scans(protocol: Mapping[str, Any], scans: Sequence[str]) -> list[str]:
    """In words, how these scans differ from those of the published mean."""
    published = protocol["published_scans"]
    missing = [number for number in published or () if f"scan{number}" not in scans]
    others = [name for name in scans if name not in {f"scan{number}" for number in published or ()}]
    if not published or not (missing or others):
        return []
    parts = [f"lacks scans {', '.join(map(str, missing))}"] if missing else []
    parts += [f"has {', '.join(others)} more"] if others else []
    return [f"{protocol['name']}: this mean {' and '.join(parts)}; the published one is of {len(published)} scans"]


def score_verdict(report: Mapping[str, Any], require: Sequence[str], *, is_damaged: bool) -> Verdict:
    """The verdict on a report: that there are views, what speaks against its figures, and each gate."""
    metrics = report["metrics"]
    num_scans = metrics.get("num_scans")
    of_scans = "" if num_scans is None else f" of {counted(num_scans, 'scan')}"
    return judged(
        dict.fromkeys(NAMES_WITH_CHANGES, None) | metrics,
        report["warnings"],
        require,
        num_views=metrics["num_views"],
        counts=counts_of(report),
        scope=f"{counted(metrics['num_views'], 'view')}{of_scans}",
        is_damaged=is_damaged,
    )


def judged(
    metrics: Mapping[str, float | None],
    warnings: Sequence[str],
    require: Sequence[str],
    *,
    num_views: float,
    counts: Mapping[str, int],
    scope: str,
    is_damaged: bool = False,
) -> Verdict:
    """The verdict on figures over `num_views` views; counts: how many views each figure rests on."""
    compared = Reason(
        criterion="views",
        outcome=Outcome.PASSED if num_views else Outcome.NOT_EVALUABLE,
        sentence=f"{counted(num_views, 'view')} compared",
        value=float(num_views),
        threshold=1.0,
        count=int(num_views),
    )
    notes = [noted("score", line) for line in warnings]
    reasons = [compared, *notes, *gate_reasons(require, metrics, counts)]
    return verdict_of("score", reasons, scope=scope, is_damaged=is_damaged, counts=counts)


def counts_of(report: Mapping[str, Any]) -> dict[str, int]:
    """How many views each metric rests on: those that have the figure; of a change, those of the metric now."""
    metrics = report["metrics"]
    each = [report] if "views" in report else list(report["results"].values())
    views = [view for one in each for view in one["views"]]
    num_views = int(metrics["num_views"])
    counts = {}
    for name in metrics:
        figure = name.removeprefix(PREFIX)
        counts[name] = sum(view[figure] is not None for view in views) if figure in views[0] else num_views
    return counts


def counted(number: float, noun: str) -> str:
    """``1 view``, ``2 views``."""
    return f"{number:.0f} {noun}{'' if number == 1 else 's'}"
