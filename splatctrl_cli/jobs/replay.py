"""A replay from its request to its result: read, replay, measure, write."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.evaluate.gates import check_gate_names, check_gates
from splatctrl_cli.io.output import Stopwatch, output_path, sha256, write_json
from splatctrl_cli.jobs.lockstep import check_lockstep, opened_scene
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.replay_baseline import read_baselines, read_zone
from splatctrl_cli.jobs.replay_files import write_replay
from splatctrl_cli.jobs.replay_goal import check_goal
from splatctrl_cli.jobs.replay_golden import Golden, check_golden, read_golden
from splatctrl_cli.jobs.replay_metrics import Metrics, first_time, metric_names, metrics_of
from splatctrl_cli.jobs.replay_modes import Replay, replayed, with_truth
from splatctrl_cli.jobs.replay_request import MODES, ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replay_robot import coverage_words, doubts_of, read_robot
from splatctrl_cli.jobs.replay_states import LoggedStates, read_states
from splatctrl_cli.jobs.replay_twists import check_twists
from splatctrl_cli.jobs.replay_worst import draw_worst_frames
from splatctrl_cli.simulate.truth import load_truth


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """What a replay found, all of it written to `out`.

    notes: sentences on the robot, the pictures and the log. is_damaged: part of the log was lost.
    """

    out: Path
    replay: Replay
    metrics: Metrics
    notes: tuple[str, ...]
    is_damaged: bool
    golden: Golden | None


def replay(request: ReplayRequest, progress: Progress = SILENT) -> ReplayResult:
    """Replay, and write the output folder. Raises SplatCtrlError for what cannot be replayed."""
    check_request(request)
    config, stopwatch = request.config, Stopwatch()
    golden = read_golden(request)
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        with stopwatch.stage("read"):
            inputs, logged = _read(request, folder, progress)
        for doubt in doubts_of(request, inputs.model, config.control):
            progress.log(f"warning: {doubt}")
        with stopwatch.stage("replay"):
            found = replayed(request, inputs, config, progress)
        with stopwatch.stage("truth"):
            found = with_truth(inputs, found)
        inputs.scene.finish()
        metrics = metrics_of(found) | logged.metrics()
        with stopwatch.stage("worst_frames"):
            unseen = draw_worst_frames(folder, inputs, found, request.worst_frames)
        write_json(folder / "states.json", logged.as_dict())
        write_replay(folder, found, metrics, config=config, inputs=inputs.digests, stopwatch=stopwatch)
    return ReplayResult(
        out=request.out,
        replay=found,
        metrics=metrics,
        notes=(coverage_words(inputs.model, config.control), *unseen, *logged.lines()),
        is_damaged=bool(inputs.source.loss.damaged),
        golden=golden,
    )


def check_request(request: ReplayRequest) -> None:
    """Raise UsageError for what no replay can be made of: gates on figures that it does not have, options that
    belong to another mode.
    """
    fields = ("exact", "barrier", *(("certified",) if request.field is not None else ()))
    baselines, has_truth = read_baselines(request), request.truth is not None
    has_twists = request.twist_topic is not None
    names = {
        mode: metric_names(mode, fields, has_truth=has_truth, baselines=baselines, has_twists=has_twists)
        for mode in MODES
    }
    check_gate_names(request.require, names[request.mode], {f"--mode {mode}": names[mode] for mode in names})
    read_zone(request)
    check_lockstep(request)
    check_twists(request)
    check_goal(request)


def _read(request: ReplayRequest, folder: Path, progress: Progress) -> tuple[ReplayInputs, LoggedStates]:
    model = read_robot(request, request.config.control)
    truth = None if request.truth is None else load_truth(request.truth)
    logged = read_states(request, model)
    scene = opened_scene(request, request.config, model, folder, progress)
    source = logged.source
    files = [path for path in (request.urdf, request.spheres, request.srdf, request.truth) if path is not None]
    digests = {**source.digests(), **scene.digests, **{path.name: sha256(path) for path in files}}
    inputs = ReplayInputs(source=source, states=logged.states, model=model, scene=scene, truth=truth, digests=digests)
    return inputs, logged


def check_result(request: ReplayRequest, result: ReplayResult) -> None:
    """Raise what the result does not hold: known space, a golden run, gates."""
    replay, metrics = result.replay, result.metrics
    if metrics["num_without_distance"]:
        raise NotEvaluableError(
            f"replay: the path leaves known space: at {metrics['num_without_distance']:g} of "
            f"{metrics['num_states']:g} states, first at "
            f"{first_time(replay, 'num_without_distance', lambda count: count == 0):.3f} s, "
            "a sphere is where the field has no distance",
            remedy="the figures above leave those states out; bake with field.unknown = free or obstacle",
        )
    unknown = metrics["unknown_share"]
    if unknown is not None and unknown > request.max_unknown:
        raise NotEvaluableError(
            f"replay: {100 * unknown:.1f} % of the sphere centres lie in space no camera ever saw, "
            f"allowed {100 * request.max_unknown:g} %, first more than that at "
            f"{_first_unknown(request, replay):.3f} s",
            remedy="the figures above say nothing about that part; add a camera, or give a larger --max-unknown",
        )
    if result.golden is not None:
        check_golden(result.golden, replay, request.golden_tolerance)
    check_gates(request.require, metrics, first_time=lambda name, holds: first_time(replay, name, holds))


def _first_unknown(request: ReplayRequest, replay: Replay) -> float:
    """The first time [s] at which more of the sphere centres than is allowed lie in space never seen."""
    stamps = replay.audit.stamp_ns
    first = int(np.argmax(replay.audit.unknown_share > request.max_unknown))
    return float(stamps[first] - stamps[0]) * 1e-9
