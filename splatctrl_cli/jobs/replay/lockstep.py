"""Reconstruction of a log in lockstep with its replay's clock."""

import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.calibration.displacement import displaced_cameras
from splatctrl_cli.config import Config, fixed
from splatctrl_cli.control.audit import Observed
from splatctrl_cli.control.near_space import Seen
from splatctrl_cli.errors import UsageError, refuse_if, require
from splatctrl_cli.files.output import Stopwatch, write_run
from splatctrl_cli.formats.scene.scene_folder import MAP_DELAYS
from splatctrl_cli.formats.scene.voxel_file import read_seen, read_unrepresented
from splatctrl_cli.formats.splat.splats import read_ply
from splatctrl_cli.jobs.check import refuse_errors
from splatctrl_cli.jobs.reconstruct.reconstruct import arm_seen
from splatctrl_cli.jobs.reconstruct.reconstruction import Reconstruction, ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import check_pose_jumps
from splatctrl_cli.jobs.replay.evidence import EVERY, every_of, select_trained, training_options
from splatctrl_cli.jobs.replay.known_scene import (
    KnownFields,
    KnownScene,
    fields_at,
    known_space,
    read_grid_scene,
    read_splat_scene,
    seen_of,
    splat_fields,
)
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.running.device import CUDA, TO_CPU, FitDevice, explain_faults
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.log.stored_frame import FrameSource
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import Float64, RecordSource, RgbdFrame, UInt8
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.time_steps import TimeStep

FOLDER = "scene"  # within the replay's folder
END: tuple[TimeStep | None, float] = (None, 0.0)  # after the last frame set


def check_lockstep(request: ReplayRequest) -> None:
    """Raise UsageError for options without effect."""
    refuse_if(
        request.latency and request.field is not None,
        "--latency: a baked field is one scene for all times",
        remedy="give --scene or --lockstep",
        error=UsageError,
    )
    refuse_if(
        not request.lockstep and (request.allow_disagreement or request.max_pose_jump != fixed.POSE_JUMP),
        "--allow-disagreement, --max-pose-jump: expected --lockstep",
        remedy="leave them out",
        error=UsageError,
    )
    refuse_if(
        request.real_time and not request.lockstep,
        "--real-time: expected --lockstep, as other maps exist already",
        remedy="leave it out",
        error=UsageError,
    )
    refuse_if(
        not request.lockstep and request.device.startswith(CUDA),
        f"--device {request.device}: expected --lockstep, as only a fit uses a GPU",
        remedy=TO_CPU,
        error=UsageError,
    )


def choose_scene(
    request: ReplayRequest,
    model: RobotModel,
    declared: Declarations,
    folder: Path,
    console: Progress,
    source: RecordSource,
    observe: Callable[[RgbdFrame], None] | None = None,
) -> KnownScene:
    """Open the request's scene; --lockstep reconstructs `source` into `folder`.

    `observe` is called with every frame of `source`.
    """
    if request.field is not None:
        refuse_if(
            request.config.control.human_margin > request.config.control.margin,
            "control.human_margin: a baked field does not tell people from objects",
            remedy="give --scene",
            error=UsageError,
        )
        return read_grid_scene(request.field)
    if request.scene is not None:
        return read_splat_scene(
            request.scene, request.config, request.threads, latency_ns=int(request.latency * 1e9 + 0.5)
        )
    return reconstruct_scene(request, model, folder, console, declared, source, observe)


def reconstruct_scene(
    request: ReplayRequest,
    model: RobotModel,
    folder: Path,
    console: Progress,
    declared: Declarations | None = None,
    source: RecordSource | None = None,
    observe: Callable[[RgbdFrame], None] | None = None,
) -> KnownScene:
    """Reconstruct a log during its replay, into `folder`/scene.

    source: the log, if open already. observe: called with every frame, the last ones in `finish`. Raises InputError
    for a log without frames or a clock.
    """
    config = request.config
    source = _training_source(request, model, source)
    check_pose_jumps(source, request.max_pose_jump)
    allowed = ("agreement", *(("views-agreement", "views-scale", "alignment") if request.allow_disagreement else ()))
    jumps = () if request.max_pose_jump == fixed.POSE_JUMP else ("pose-jump",)
    refuse_errors(request.log, request.options, (*allowed, *jumps))
    place = folder / FOLDER
    place.mkdir()
    seen = arm_seen(model, source, console)
    fitted = Reconstruction(
        ReconstructRequest(
            source=source,
            out=place,
            config=config,
            seed=request.seed,
            threads=request.threads,
            allow_disagreement=request.allow_disagreement,
        ),
        model,
        place,
        identity={"command": "replay --lockstep"},
        declared=declared,
        observe=observe,
        device=FitDevice(request.device),
        cameras_off={} if seen is None else displaced_cameras(*seen),
    )
    return Lockstep(
        fitted,
        config,
        int(request.latency * 1e9 + 0.5),
        console,
        ends_with_log=request.mode != "closed-loop",
        is_real_time=request.real_time,
        held_out_every=every_of(request.evidence),
    ).scene()


class Lockstep:
    """Frame sets to come, and stamps and files of maps so far.

    ends_with_log: known space is that of the whole log, else of the frame sets taken. is_real_time: each map but the
    first is known when this machine has computed it (its known space when the computation begins). Of the frame sets
    that arrive meanwhile, only the newest is kept. held_out_every: k if each k-th set is evidence and left out.
    """

    def __init__(
        self,
        fitted: Reconstruction,
        config: Config,
        latency_ns: int,
        console: Progress,
        *,
        ends_with_log: bool,
        is_real_time: bool = False,
        held_out_every: int | None = None,
    ) -> None:
        self._fitted, self._config, self._console = fitted, config, console
        self._latency_ns, self._ends_with_log, self._is_real_time = latency_ns, ends_with_log, is_real_time
        self._stopwatch = Stopwatch()
        self._taking: list[tuple[int, float]] = []  # stamp [ns] and duration [s] of each frame set
        self._held_out_every = held_out_every
        self._steps = self._decode(select_trained(fitted.time_steps(), held_out_every))
        self._free_ns, self._num_dropped = 0, 0  # when the last frame set is done; frame sets left out
        self._next, self._decoding = next(self._steps, END)
        self._stamps_ns: list[int] = []
        self._known_ns: list[int] = []
        self._files: list[Path] = []
        # known space, after a number of frame sets
        self._known: tuple[int, Observed] = (0, lambda points: np.zeros(len(points), np.uint8))

    def scene(self) -> KnownScene:
        """Return the scene of a replay; take frame sets up to the first map now."""
        while self._next is not None and not self._stamps_ns:
            self._take()
        self._fitted.check_found()

        def fields(file: Path) -> KnownFields:
            balls = read_unrepresented(file.with_suffix(".npz"))
            return splat_fields(read_ply(file)[0], self._config, self._fitted.request.threads, balls)

        known_at = fields_at(self._known_ns, self._files.__getitem__, fields)
        voxels = lru_cache(maxsize=1)(lambda file: read_seen(file.with_suffix(".npz")))

        def at(stamp_ns: int) -> KnownFields:
            self._advance(stamp_ns)
            return known_at(stamp_ns)

        def seen_at(stamp_ns: int) -> Seen | None:
            self._advance(stamp_ns)
            index = bisect_right(self._known_ns, stamp_ns) - 1
            known = None if index < 0 else voxels(self._files[index])
            return None if known is None else seen_of(known)

        return KnownScene(
            at=at,
            seen_at=seen_at,
            figures=self._figures,
            observed=self._observe,
            first_ns=self._known_ns[0],
            cameras=tuple(self._fitted.cameras),
            digests={},
            stamps_ns=self._stamps_ns,
            known_ns=self._known_ns,
            advance=self._advance,
            finish=self._finish,
        )

    def _advance(self, stamp_ns: int) -> None:
        while self._next is not None and self._start_ns(self._next) <= stamp_ns:
            self._take()

    def _start_ns(self, step: TimeStep) -> int:
        return max(step.stamp_ns + self._latency_ns, self._free_ns)

    def _decode(self, steps: Iterator[TimeStep]) -> Iterator[tuple[TimeStep, float]]:
        """Yield frame sets, each with the time [s] its decoding took."""
        while True:
            start = time.perf_counter()
            with self._stopwatch.stage("read"):
                step = next(steps, None)
            if step is None:
                return
            yield step, time.perf_counter() - start

    def _take(self) -> None:
        step, decoding, fitted, start = self._next, self._decoding, self._fitted, time.perf_counter()
        assert step is not None
        with self._stopwatch.stage("fit"), explain_faults(fitted.device):
            fitted.take(step, self._console)
        seconds = decoding + time.perf_counter() - start
        self._next, self._decoding = next(self._steps, END)
        start, taken = time.perf_counter(), fitted.writer.snapshots
        if self._next is None and fitted.rows and taken[-1].stamp_ns < step.stamp_ns:
            fitted.snapshot(step.stamp_ns)  # the log's last map, due or not
        fitted.writer.settle()
        seconds += time.perf_counter() - start
        self._taking.append((step.stamp_ns, seconds))
        known_ns = self._start_ns(step)
        if self._is_real_time:
            known_ns += round(1e9 * seconds) if self._known_ns else 0
            self._skip(known_ns)
        for snapshot in taken[len(self._files) :]:
            self._stamps_ns.append(snapshot.stamp_ns)
            self._known_ns.append(known_ns)
            self._files.append(snapshot.path)

    def _skip(self, free_ns: int) -> None:
        """Drop all but the newest of the frame sets that came until `free_ns`."""
        self._free_ns = free_ns
        while self._next is not None and self._next.stamp_ns + self._latency_ns <= free_ns:
            newer, decoding = next(self._steps, END)
            if newer is None or newer.stamp_ns + self._latency_ns > free_ns:
                self._steps = self._steps if newer is None else chain([(newer, decoding)], self._steps)
                return
            self._next, self._decoding, self._num_dropped = newer, decoding, self._num_dropped + 1

    def _figures(self) -> dict[str, Any]:
        if not self._is_real_time:
            return self._fitted.metrics()
        delays = np.subtract(self._known_ns, self._stamps_ns) * 1e-9
        return self._fitted.metrics() | {"num_dropped_sets": self._num_dropped, MAP_DELAYS: delays.tolist()}

    def _observe(self, points: Float64) -> UInt8:
        while self._ends_with_log and self._next is not None:
            self._take()
        num_taken, known = self._known
        if num_taken != len(self._fitted.rows):
            known = known_space(self._fitted.fitter.occupancy.grid())
            self._known = len(self._fitted.rows), known
        return known(points)

    def _finish(self) -> None:
        """Write a scene folder; remaining frames go only to `observe`."""
        fitted = self._fitted
        if fitted.observe is not None:
            deque(self._steps, maxlen=0)
        with self._stopwatch.stage("write"):
            fitted.finish()
        write_run(
            fitted.writer.folder,
            command="replay",
            config=self._config.as_dict(),
            inputs=fitted.source.digests(),
            metrics=self._figures() | {EVERY: self._held_out_every},
            stopwatch=self._stopwatch,
            seed=fitted.request.seed,
        )
        fitted.device.close()
        stamps_ns, seconds = zip(*self._taking, strict=True)
        middle, most = (f"{1e3 * float(t):.0f} ms" for t in np.percentile(seconds, [50, 99]))
        apart = f", recorded {1e-6 * float(np.median(np.diff(stamps_ns))):.0f} ms apart" if len(stamps_ns) > 1 else ""
        self._console.log(
            f"lockstep: {len(seconds)} frame sets{apart}, took {middle} each in the median, {most} at 99 %; their"
            f" maps are in {FOLDER}/"
        )


def _training_source(request: ReplayRequest, model: RobotModel, source: RecordSource | None) -> FrameSource:
    source = open_states(request.log, request.options, model.joint_names) if source is None else source
    refuse_if(
        not source.cameras,
        f"{request.log}: --lockstep: expected cameras, got joint states alone",
        remedy="give --scene or --field of the same place",
    )
    if request.evidence in source.cameras:
        source = open_states(request.log, training_options(request, source.cameras), model.joint_names)
    return require(
        source if isinstance(source, LOGGED) else None,
        f"{request.log}: --lockstep: expected a log or a capture",
        remedy="give --scene or --field",
        error=UsageError,
    )
