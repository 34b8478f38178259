"""The plots of a replay's output folder, and pictures of the moments at which it was nearest to the scene."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.events import INTERVENTIONS, SHOWN, Event, EventKind
from splatctrl_cli.evaluate.worst_frames import Moment, Sight, draw_sight, sights_of, worst_moments
from splatctrl_cli.jobs.replay.request import ReplayInputs
from splatctrl_cli.jobs.replay.result import Replay
from splatctrl_cli.records import Float64, FloatRows, RgbdFrame
from splatctrl_cli.report.replay_pictures import (
    clearance_picture,
    commands_picture,
    divergence_picture,
    evidence_picture,
    open_loop_picture,
)

NAMES = {"exact": "exact", "barrier": "barrier", "certified": "certified bound"}  # of the fields, in a caption
TITLES = {
    "audit": "Clearance of the logged motion",
    "open-loop": "Clearance of the logged motion",
    "closed-loop": "Clearance in closed loop",
}
ROWS = ("scene", "self", "limit")  # kinds of rows that shape a command


def draw_replay(folder: Path, replay: Replay, seconds: Float64) -> None:
    """Write clearance.png, and evidence.png where that is known; of a controller commands.png, in open loop
    open_loop.png, in closed loop divergence.png.

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
    if np.isfinite(shares := replay.near["shares"]).any():
        evidence_picture(folder / "evidence.png", seconds, shares)
    if replay.kept_steps is not None:
        broken = frozenset({EventKind.ROW_BROKEN})
        kinds, rows = (INTERVENTIONS, ROWS) if replay.outside is None else (broken, tuple(broken))
        commands_picture(
            folder / "commands.png",
            seconds,
            replay.kept_steps.velocity,
            replay.model.joint_names,
            replay.model.velocity_limit,
            _intervals(replay, lambda event: event.kind in kinds, at_least=rows),
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
    if replay.divergence is not None and np.isfinite(replay.divergence["joints"]).any():
        of = [replay.divergence[name] for name in ("joints", "position", "rotation")]
        divergence_picture(folder / "divergence.png", seconds, *of)


def _intervals(
    replay: Replay, is_shown: Callable[[Event], bool], *, at_least: Sequence[str] = ()
) -> dict[str, list[tuple[float, float]]]:
    """First and last time [s] of the events that are shown, by kind and measure; `at_least` these kinds, if empty."""
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in at_least}
    for event in replay.events:
        if is_shown(event):
            found.setdefault(f"{event.kind}{SHOWN.get(event.source, '')}", []).append((event.start_s, event.end_s))
    return found


def worst_sights(inputs: ReplayInputs, replay: Replay, num: int, frames: Iterable[RgbdFrame]) -> list[Sight | None]:
    """The images of the moments of least clearance, by the truth where that is known, the least first; None where no
    camera has one. Frames behind the last moment are not read.
    """
    audit = replay.audit
    least = audit.clearance["exact"].distance
    if replay.true_clearance is not None:
        least = np.fmin(least, np.asarray(replay.true_clearance))
    states = worst_moments(audit.stamp_ns, least, num)
    if not states or not inputs.source.has_clock:
        return []
    return sights_of([_moment(inputs, replay, state) for state in states], frames)


def draw_worst_frames(folder: Path, replay: Replay, sights: Sequence[Sight | None]) -> list[str]:
    """Write worst_1.png, worst_2.png ...; what there is to say of it."""
    seen = [sight for sight in sights if sight is not None]
    for number, sight in enumerate(seen, start=1):
        draw_sight(folder / f"worst_{number}.png", _explained(sight, number, replay))
    if len(seen) < len(sights):
        return [f"worst frames: no camera image at or before {len(sights) - len(seen)} of {len(sights)} moments"]
    return []


def _moment(inputs: ReplayInputs, replay: Replay, state: int) -> Moment:
    """A state with the obstacle that is nearest to its nearest sphere."""
    audit, model = replay.audit, replay.model
    stamp, worst = int(audit.stamp_ns[state]), int(audit.clearance["exact"].sphere[state])
    centers = model.sphere_centers(np.asarray(audit.position[state]))
    (obstacle,) = inputs.scene.at(stamp).obstacles(np.ascontiguousarray(centers[[worst]]))
    figures = [f"{NAMES.get(name, name)} {_cm(float(of.distance[state]))}" for name, of in audit.clearance.items()]
    if replay.true_clearance is not None:
        figures.append(f"truth {_cm(float(replay.true_clearance[state]))}")
    step = replay.steps[state] if replay.steps else None
    rung = "" if step is None else f"   step: {step.rung}" + (f", scaled by {step.scale:g}" if step.scale < 1 else "")
    seconds = (stamp - int(audit.stamp_ns[0])) * 1e-9
    return Moment(
        stamp_ns=stamp,
        centers=centers,
        radii=np.asarray(model.sphere_set.radii),
        is_moving=np.asarray(model.moving_spheres),
        worst=worst,
        obstacle=np.array(obstacle.position),
        caption=(
            f"{seconds:.2f} s   {sphere_names(model.sphere_set)[worst]}   clearance: {', '.join(figures)}{rung}",
            f"nearest: {obstacle}",
        ),
    )


def _explained(sight: Sight, number: int, replay: Replay) -> Sight:
    """The sight with its number, camera, and whose spheres are drawn."""
    first, *rest = sight.moment.caption
    whose = (
        "spheres of the driven arm; the image shows the logged one"
        if replay.mode == "closed-loop"
        else "spheres of the logged posture"
    )
    caption = (f"worst {number}   {first}", *rest, f"{sight.frame.camera}, taken {sight.age_s:.2f} s before; {whose}")
    return replace(sight, moment=replace(sight.moment, caption=caption))


def _cm(metres: float) -> str:
    return f"{100 * metres:.2f} cm"
