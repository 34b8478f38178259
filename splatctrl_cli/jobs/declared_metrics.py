"""The figures of every command that judges, by which two runs of it are compared."""

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass
from functools import cache

from splatctrl_cli.config.fixed import BANDS
from splatctrl_cli.evaluate import field_accuracy, score_report
from splatctrl_cli.evaluate.field_truth import FIELDS
from splatctrl_cli.evaluate.metrics import Better, Scale, Shown
from splatctrl_cli.jobs import bake, reconstruct_gaussians, reconstruct_verdict, robot, score_fit
from splatctrl_cli.jobs.replays.metrics import metric_scales, shown_metrics
from splatctrl_cli.jobs.replays.request import MODES
from splatctrl_cli.jobs.replays.standstill_baseline import BASELINES

REPLAY_FIELDS = ("exact", "barrier", "certified")
WORDS = {  # of a name in the documentation, for those that it stands for
    "METHOD": ("closed_loop", "log", "birrt_ik", "birrt", "standstill"),
    "FIELD": ("exact", "barrier", "certified"),
    "REGION": ("seen", "all", "masked"),
    "FIT": ("3dgs", "ours"),
}


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Figures of a command that are compared alike, as the documentation's table has them."""

    command: str
    names: tuple[str, ...]
    scale: Scale

    @property
    def docs(self) -> str:
        """The row of the table, its cells separated by |."""
        scale, shown = self.scale, ", ".join(f"`{name}`" for name in self.names)
        parts = [f"{scale.absolute:g} {scale.unit}".rstrip()] if scale.absolute else []
        parts += [f"{100 * scale.relative:g} %"] if scale.relative else []
        return f"{self.command} | {shown} | {scale.unit or '-'} | {scale.better} | {' + '.join(parts) or '0'}"


@cache
def scales() -> Mapping[str, Mapping[str, Scale]]:
    """How two runs are compared by each figure, by command and name."""
    replay: dict[str, Scale] = {}
    for mode in MODES:
        replay |= metric_scales(mode, REPLAY_FIELDS, has_truth=True, baselines=BASELINES, has_twists=True)
    bands = [field_accuracy.band_name(lower, upper) for lower, upper in BANDS]
    return {
        "reconstruct": reconstruct_gaussians.GATED | reconstruct_verdict.GATED,
        "sdf-bake": bake.SUMMARY_METRICS | field_accuracy.metric_scales(FIELDS, bands),
        "score": score_report.SCALES | score_fit.GATED,
        "replay": replay,
        "robot": robot.SCALES,
    }


@cache
def shown() -> Mapping[str, Shown]:
    """Where the ``steps.csv`` of a replay shows its figures, by name."""
    return {name: where for mode in MODES for name, where in shown_metrics(mode, REPLAY_FIELDS).items()}


def documented() -> Iterator[Compared]:
    """The rows of the documentation's table: figures that have a direction, alike ones together."""
    for command, of_name in scales().items():
        alike: dict[Scale, list[str]] = {}
        for name, scale in of_name.items():
            if scale.better is not Better.NEITHER:
                alike.setdefault(scale, []).append(_general(name, of_name))
        for scale, names in alike.items():
            yield Compared(command=command, names=tuple(dict.fromkeys(names)), scale=scale)


def _general(name: str, names: Container[str]) -> str:
    """A name with a word for what is one of several among `names`: ``seen.FIELD.BAND.rmse``, ``METHOD_success``."""
    if name.startswith(("everywhere.", "seen.")):
        where, *_, figure = name.split(".")
        return f"{where}.FIELD.BAND.{figure}"
    for word, choices in WORDS.items():
        for choice in choices:
            head, tail = name.removeprefix(f"{choice}_"), name.removesuffix(f"_{choice}")
            if head != name and sum(f"{other}_{head}" in names for other in choices) > 1:
                return f"{word}_{head}"
            if tail != name and sum(f"{tail}_{other}" in names for other in choices) > 1:
                return f"{tail}_{word}"
    return name
