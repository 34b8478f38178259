"""The plots of a replay's output folder."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatctrl_cli.control.events import INTERVENTIONS, SHOWN, Event
from splatctrl_cli.records import Float64, FloatRows
from splatctrl_cli.report.replay_pictures import (
    clearance_picture,
    commands_picture,
    divergence_picture,
    open_loop_picture,
)

if TYPE_CHECKING:
    from splatctrl_cli.jobs.replay_modes import Replay

TITLES = {
    "audit": "Clearance of the logged motion",
    "open-loop": "Clearance of the logged motion",
    "closed-loop": "Clearance in closed loop",
}
ROWS = ("scene", "self", "limit")  # kinds of rows that shape a command


def draw_replay(folder: Path, replay: "Replay", seconds: "Float64") -> None:
    """Write clearance.png; of a controller commands.png, in open loop open_loop.png, in closed loop divergence.png.

    seconds: (T,) since the first state.
    """

    curves: dict[str, FloatRows] = {name: of.rows for name, of in replay.audit.clearance.items()}
    if replay.true_clearance is not None:
        curves["truth"] = replay.true_clearance
    happened = _intervals(replay, lambda event: event.kind not in INTERVENTIONS and event.source in SHOWN)
    title = TITLES[replay.mode]
    if replay.closed_loop is not None and replay.start_time_s > 0:
        title += f", from {replay.start_time_s:.2f} s of the log"
    clearance_picture(folder / "clearance.png", seconds, curves, replay.margin, title, happened)
    if replay.kept_steps is not None:
        commands_picture(
            folder / "commands.png",
            seconds,
            replay.kept_steps.velocity,
            replay.model.joint_names,
            replay.model.velocity_limit,
            _intervals(replay, lambda event: event.kind in INTERVENTIONS, at_least=ROWS),
            None if replay.open_loop is None else replay.open_loop.logged,
        )
    if replay.open_loop is not None:
        shaped = [(event.start_s, event.end_s) for event in replay.events if event.kind in ROWS]
        open_loop_picture(
            folder / "open_loop.png",
            seconds,
            replay.open_loop.difference,
            replay.model.joint_names,
            replay.open_loop.figures.rows("barrier"),
            shaped,
        )
    if replay.divergence is not None and np.isfinite(np.asarray(replay.divergence.joints)).any():
        of = replay.divergence
        divergence_picture(folder / "divergence.png", seconds, of.joints, of.position, of.rotation)


def _intervals(
    replay: "Replay", is_shown: "Callable[[Event], bool]", *, at_least: Sequence[str] = ()
) -> dict[str, list[tuple[float, float]]]:
    """First and last time [s] of the events that are shown, by kind and measure; `at_least` these kinds, if empty."""
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in at_least}
    for event in replay.events:
        if is_shown(event):
            found.setdefault(f"{event.kind}{SHOWN.get(event.source, '')}", []).append((event.start_s, event.end_s))
    return found
