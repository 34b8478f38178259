"""Time to find surface without splats and to evict splats for it, as a share of a time step."""

import contextlib
import io
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from benchmarks.measure import ROBOT, SAMPLE, Limit, Options, Result
from splatctrl_cli.cli.main import main
from splatctrl_cli.scene import fitter

BUDGETS = (3000, 5000)  # one that starves, and the default
PARTS = {"bare voxels": (fitter, "unrepresented_voxels"), "room": (fitter, "room_for")}
WHOLE = (fitter.SceneFitter, "step")
LARGEST_SHARE = 0.03


def run(options: Options) -> Result:
    """Run `splatctrl reconstruct` on the sample log; measure the parts that find bare voxels and evict."""
    rows, figures = [], {}
    for budget in BUDGETS[:1] if options.is_quick else BUDGETS:
        spent = _spent(budget)
        share = sum(spent[name] for name in PARTS) / spent["steps"]
        rows.append([str(budget), *(f"{spent[name]:.2f}" for name in (*PARTS, "steps")), f"{100 * share:.1f}"])
        figures[f"budget_{budget}_share"] = share
    return Result(
        title="eviction_cost: the sample log, seconds of the whole run",
        columns=("splats", *PARTS, "time steps", "share [%]"),
        rows=rows,
        figures=figures,
        limits=[Limit(figure=name, bound=LARGEST_SHARE) for name in figures],
    )


def _spent(budget: int) -> dict[str, float]:
    """Seconds by part in one reconstruction."""
    spent = dict.fromkeys((*PARTS, "steps"), 0.0)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        for name, (owner, attribute) in {**PARTS, "steps": WHOLE}.items():
            stack.enter_context(_timed(owner, attribute, name, spent))
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        cameras = ["--cameras", "cam0,cam1,cam2", "--max-splats", str(budget)]
        assert main(["reconstruct", str(SAMPLE / "log.mcap"), *cameras, *ROBOT, "-o", f"{folder}/scene", "-q"]) == 0
    return spent


@contextmanager
def _timed(owner: Any, attribute: str, name: str, spent: dict[str, float]) -> Iterator[None]:
    original: Callable[..., Any] = getattr(owner, attribute)

    def measured(*arguments: Any, **named: Any) -> Any:
        start = time.perf_counter()
        try:
            return original(*arguments, **named)
        finally:
            spent[name] += time.perf_counter() - start

    with patch.object(owner, attribute, measured):
        yield
