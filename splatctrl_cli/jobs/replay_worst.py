"""``--worst-frames``: pictures of the moments at which a replay was nearest to the scene."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.evaluate.worst_frames import Moment, Sight, draw_sight, sights_of, worst_moments
from splatctrl_cli.jobs.replay_request import ReplayInputs
from splatctrl_cli.records import RgbdFrame

if TYPE_CHECKING:
    from splatctrl_cli.jobs.replay_modes import Replay

NAMES = {"exact": "exact", "barrier": "barrier", "certified": "certified bound"}  # of the fields, in a caption


def draw_worst_frames(folder: Path, inputs: "ReplayInputs", replay: "Replay", num: int) -> list[str]:
    """Write worst_1.png (the least clearance, by the truth where that is known), worst_2.png ...; what there is to
    say of it.
    """

    audit = replay.audit
    least = audit.clearance["exact"].distance
    if replay.true_clearance is not None:
        least = np.fmin(least, np.asarray(replay.true_clearance))
    states = worst_moments(audit.stamp_ns, least, num)
    if not states or not inputs.source.has_clock:
        return []
    moments = [_moment(inputs, replay, state) for state in states]
    sights = sights_of(moments, _frames(inputs))
    seen = [sight for sight in sights if sight is not None]
    for number, sight in enumerate(seen, start=1):
        draw_sight(folder / f"worst_{number}.png", _explained(sight, number, replay))
    if len(seen) < len(states):
        return [f"worst frames: no camera image at or before {len(states) - len(seen)} of {len(states)} moments"]
    return []


def _frames(inputs: "ReplayInputs") -> "Iterator[RgbdFrame]":

    records = inputs.source.records() if inputs.source.cameras else ()
    return (record for record in records if isinstance(record, RgbdFrame))


def _moment(inputs: "ReplayInputs", replay: "Replay", state: int) -> "Moment":
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


def _explained(sight: "Sight", number: int, replay: "Replay") -> "Sight":
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
