"""The bound on a map's error, compared with the truth on random tables.

Each seed is a table with random objects and an arm that crosses it. On every other seed, an object appears and
leaves. Three cameras train in lockstep; the fourth is evidence. Each scene has two tests.

First, the guarantee: one random block of held-out frame sets is left out, and the other blocks give the bound. The
map's residuals on the block's true surface (the same views without noise) should not exceed the bound.

Second, the verdict's use: the map's clearance minus the bound of all blocks should be a lower bound of the true
clearance. This is tested at every state truly nearer than `verdict.evidence_reach`. It also concerns surface that the
held-out camera does not see, for which there is no guarantee.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from benchmarks.measure import Options, Result
from benchmarks.random_tabletop import random_things
from splatctrl_cli.config import Config, load_config
from splatctrl_cli.config.fixed import FEWEST_BLOCKS
from splatctrl_cli.evaluate.conformal import autocorrelation_time, block_of_sets, block_scores, conformal_rank
from splatctrl_cli.jobs.replay.evidence import residuals_of
from splatctrl_cli.jobs.replay.inputs import open_log, read_states
from splatctrl_cli.jobs.replay.lockstep import reconstruct_scene
from splatctrl_cli.jobs.replay.request import ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replay.state_pass import ReplayRecord, blocks_of
from splatctrl_cli.jobs.running.progress import SILENT
from splatctrl_cli.recording.container.mcap_writer import mcap_log
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, JointState, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.time_steps import TimeStep
from splatctrl_cli.simulate.arm import Motion, arm_spheres_yaml, arm_urdf
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import NOISES, START_NS, Recording, RecordingOptions, Scene
from splatctrl_cli.simulate.tabletop import WAYPOINTS, furniture
from splatctrl_cli.simulate.truth import distance_to

EVIDENCE = "cam3"
TRAINING = ("cam0", "cam1", "cam2")
SIZE = (80, 60)
FPS, DURATION_S = 5.0, 8.0
SETTINGS = ("scene.max_splats=5000", "scene.first_iterations=20", "scene.iterations_per_step=2")
NUM_SCENES, QUICK = 200, 4
CLEAR = 0.01  # [m] at least between the moving arm and a thing
GUESTS = 10**6  # added to a seed for the thing that visits
ASKED = 0.5  # confidence for a further block, beside as much as the blocks allow: a single one allows it


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One scene: `kind` still or visited; num_blocks blocks of `length` sets. `further` [m]: largest residual of
    the block left out. It should be within `bound` [m] with probability `promise`; with the highest probability that
    the blocks allow, within `highest` [m] with highest_promise. least_margin [m]: least true clearance minus (map's
    clearance minus `full`), inf if no state is near. `full`: bound of all blocks with full_promise.
    """

    seed: int
    kind: str
    num_sets: int
    num_blocks: int
    length: int
    bound: float
    promise: float
    further: float
    highest: float
    highest_promise: float
    full: float
    full_promise: float
    least_margin: float
    seconds: float


def random_scene(options: RecordingOptions, robot: RobotModel) -> Scene:
    """Random objects on the table of `tabletop`, and an arm that passes its waypoints, roughly and in random order.
    On odd seeds, there is one more object for a third of the time. Objects in the arm's path are omitted, because the
    field is no bound inside objects, and the map excludes the robot.
    """
    seed, span = options.seed, round(options.duration_s * 1e9)
    rng = np.random.default_rng([seed, 7])
    order = rng.permutation(len(WAYPOINTS)).tolist()
    waypoints = np.array([WAYPOINTS[k] for k in (*order, order[0])])
    waypoints = waypoints + rng.uniform(-0.15, 0.15, waypoints.shape)
    motion = Motion(times=np.linspace(0.06, 0.94, len(waypoints)) * options.duration_s, waypoints=waypoints)
    centers = robot.sphere_centers_batch(np.array([motion.at(t)[0] for t in np.linspace(0, options.duration_s, 200)]))
    radii = np.broadcast_to(robot.sphere_set.radii, centers.shape[:2]).ravel()

    def is_clear(thing: Primitive) -> bool:
        return float((distance_to([thing], centers.reshape(-1, 3), START_NS) - radii).min()) > CLEAR

    first = START_NS + int(span * rng.uniform(0.2, 0.5))
    there = (first, first + span // 3) if seed % 2 else (START_NS - 2, START_NS - 1)
    guest = next(thing for thing in random_things(seed + GUESTS) if is_clear(thing))
    visiting = replace(guest, name="visitor", from_ns=there[0], to_ns=there[1])
    things = [thing for thing in random_things(seed) if is_clear(thing)]
    return Scene(primitives=(*furniture(), *things, visiting), temporary=(visiting,), motion=motion)


def run(options: Options) -> Result:
    """Measure coverage, its nominal value, and the width of the bound, by kind and overall."""
    num = QUICK if options.is_quick else NUM_SCENES
    trials = [found for found in map(trial_of, range(num)) if found is not None]
    median = np.median([(trial.num_blocks, trial.length, trial.seconds) for trial in trials], axis=0)
    return Result(
        title=f"conformal: {num} random tables",
        columns=("scenes", "of", "number", "promised %", "covered %", "median mm", "90 % mm"),
        rows=rows_of(trials),
        notes=[
            "{:g} blocks in the median, of {:g} sets; {:.1f} s of one core a scene".format(*median),
            f"{num - len(trials)} scenes make fewer than {FEWEST_BLOCKS} blocks: not evaluable",
        ],
    )


def trial_of(seed: int) -> Trial | None:
    """One scene, None if its held-out sets form fewer than FEWEST_BLOCKS blocks."""
    start = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording, options = recorded(seed, folder), SourceOptions(cameras=TRAINING)
        config = load_config(None, SETTINGS)
        urdf, spheres = folder / "robot.urdf", folder / "robot_spheres.yaml"
        model = RobotModel.from_urdf(urdf, spheres)
        request = ReplayRequest(
            log=folder / "log.mcap", urdf=urdf, spheres=spheres, out=folder, config=config, options=options, threads=1
        )
        states = read_states(open_log(request)[1], model)
        scene = reconstruct_scene(request, model, folder, SILENT)
        inputs = ReplayInputs(
            source=states.source, states=states.states, model=model, scene=scene, truth=None, digests={}
        )
        record, over = audited(inputs, recording, config)
        reach = config.verdict.evidence_reach
        measured, exact = (
            residuals_of(sets, inputs, record.trace, reach)[1][:, 0] for sets in evidence_of(recording)
        )
    return judged(seed, measured, exact, over, config.verdict.confidence, time.process_time() - start)


def recorded(seed: int, folder: Path) -> Recording:
    """The recording of a seed, with its log and robot in a folder."""
    urdf, spheres = folder / "robot.urdf", folder / "robot_spheres.yaml"
    urdf.write_text(arm_urdf(), encoding="utf-8")
    spheres.write_text(arm_spheres_yaml(), encoding="utf-8")
    options = RecordingOptions(duration_s=DURATION_S, fps=FPS, width=SIZE[0], height=SIZE[1], seed=seed, color_rays=0)
    robot = RobotModel.from_urdf(urdf, spheres)
    recording = Recording(options, robot, random_scene(options, robot))
    with mcap_log(folder / "log.mcap") as log:
        log.add_transforms(recording.start_ns, recording.static_transforms(), is_static=True)
        records: list[JointState | RgbdFrame] = list(recording.joint_states())
        records += [frame for step in frame_sets(recording, TRAINING) for frame in step.frames]
        for record in sorted(records, key=lambda record: record.stamp_ns):
            if isinstance(record, JointState):
                log.add_joint_state(record, recording.robot.joint_names)
            else:
                log.add_frame(record)
    return recording


def frame_sets(recording: Recording, cameras: tuple[str, ...]) -> Iterator[TimeStep]:
    """The frames of some cameras."""
    for index in range(int(recording.options.duration_s * recording.options.fps)):
        q = recording._motion.at(recording._offset_ns(index) / 1e9)[0]
        yield TimeStep(frames=tuple(recording.frames_at(index, q, cameras)), position=None)


def evidence_of(recording: Recording) -> tuple[list[TimeStep], list[TimeStep]]:
    """The held-out camera's frames, as measured and with exact depth."""
    noise, seed = NOISES[recording.options.noise], recording.options.seed
    assert noise is not None
    options = RecordingOptions(**{**vars(recording.options), "noise": "none"})
    again = Recording(options, recording.robot, random_scene(options, recording.robot))
    exact = list(frame_sets(again, (EVIDENCE,)))
    measured = []
    for index, step in enumerate(exact):
        (frame,) = step.frames
        depth = noise.applied(frame.depth, np.random.default_rng([seed, 3, index]))
        measured.append(replace(step, frames=(replace(frame, depth=depth),)))
    return measured, exact


def audited(inputs: ReplayInputs, recording: Recording, config: Config) -> tuple[ReplayRecord, Float64]:
    """The audit of the logged states, and by how much (T,) [m] the map's clearance exceeds the truth at those that
    are truly near, -inf at the others.
    """
    scene, states, model = inputs.scene, inputs.states, inputs.model
    assert scene.first_ns is not None
    first = int(np.searchsorted(states.stamp_ns, scene.first_ns))
    record = ReplayRecord(model, scene, config=config, max_map_age=1.0)
    moving = np.flatnonzero(model.moving_spheres)
    radii, over = model.sphere_set.radii[moving], []
    stamps = states.stamp_ns[first:]
    for begin, end in blocks_of(scene, model, stamps):
        q = np.asarray(states.position[first + begin : first + end])
        part = record.measure_block(stamps[begin:end], q, np.zeros_like(q))
        centers = model.sphere_centers_batch(q)[:, moving]
        for index, stamp in enumerate(stamps[begin:end].tolist()):
            true = float((distance_to(recording.primitives, centers[index], stamp) - radii).min())
            is_near = true < config.verdict.evidence_reach
            over.append(float(part.clearance["exact"].distance[index]) - true if is_near else -np.inf)
    return record, np.array(over)


def judged(
    seed: int, measured: Float64, exact: Float64, over: Float64, confidence: float, seconds: float
) -> Trial | None:
    """Both tests, for a scene's residuals with and without noise."""
    length = autocorrelation_time(measured)
    block = block_of_sets(len(measured), length)
    scores, deciding = block_scores(measured, block)
    if len(scores) < FEWEST_BLOCKS:
        return None
    drawn = int(np.random.default_rng([seed, 8]).integers(len(scores)))
    core = np.flatnonzero(block == block[deciding[drawn]])[:length]
    others = np.delete(scores, drawn)
    return Trial(
        seed=seed,
        kind="visited" if seed % 2 else "still",
        num_sets=len(block),
        num_blocks=len(scores),
        length=length,
        bound=_bound(others, ASKED)[0],
        promise=_bound(others, ASKED)[1],
        further=float(np.nanmax(exact[core])),
        highest=_bound(others, confidence)[0],
        highest_promise=_bound(others, confidence)[1],
        full=_bound(scores, confidence)[0],
        full_promise=_bound(scores, confidence)[1],
        least_margin=_bound(scores, confidence)[0] - float(over.max(initial=-np.inf)),
        seconds=seconds,
    )


def _bound(scores: Float64, confidence: float) -> tuple[float, float]:
    """The bound [m], not below 0, and the confidence that the scores allow."""
    allowed = min(confidence, len(scores) / (len(scores) + 1))
    return max(float(np.sort(scores)[conformal_rank(len(scores), allowed) - 1]), 0.0), allowed


def rows_of(trials: Sequence[Trial]) -> list[list[str]]:
    """Rows of coverage, its nominal value, and the bound's width, by kind and overall."""
    rows = []
    by_kind = sorted(trials, key=lambda trial: trial.kind)
    groups = [(kind, list(group)) for kind, group in groupby(by_kind, key=lambda trial: trial.kind)]
    for kind, group in [*groups, ("all", list(trials))]:
        for what, promise, width, is_covered in (
            ("a further block", "promise", "bound", lambda t: t.further <= t.bound),
            ("a further block", "highest_promise", "highest", lambda t: t.further <= t.highest),
            ("the arm", "full_promise", "full", lambda t: t.least_margin >= 0),
        ):
            promised = float(np.mean([getattr(trial, promise) for trial in group]))
            covered = sum(is_covered(trial) for trial in group)
            widths = 1e3 * np.array([getattr(trial, width) for trial in group])
            share = covered / len(group)
            spread = 1.96 * np.sqrt(share * (1 - share) / len(group))
            figures = (f"{100 * promised:.1f}", f"{100 * share:.1f} +- {100 * spread:.1f}")
            width_mm = (f"{np.median(widths):.1f}", f"{np.percentile(widths, 90):.1f}")
            rows.append([kind, what, str(len(group)), *figures, *width_mm])
    return rows
