"""An arm's task near a person: by the controller on a map built during the motion, and by the standstill.

The controller's loop is closed through the cameras: every frame shows the arm at its driven posture. J joints, T
states, H x W pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from experiments.shared_workspace import HOME, TASK
from experiments.standstill import STOP_ACCELERATION, BoxZone, StopZone, Zone, monitored_standstill
from splatctrl_cli import Box, Config
from splatctrl_cli.blocks import (
    START_NS,
    AuditRow,
    Bool,
    DistanceField,
    Float64,
    Guide,
    KnownFields,
    KnownScene,
    LoggedMotion,
    Primitive,
    QpIkController,
    Recording,
    RgbdFrame,
    RobotModel,
    SceneFitter,
    SceneStep,
    SeenVoxels,
    UInt8,
    closest_of,
    distance_to,
    fields_at,
    is_at_goal,
    known_space,
    posture_of,
    rate_of,
    runs_of,
    seen_of,
    self_mask_metrics,
    splat_fields,
)

FRAME = "hand"
FPS = 10.0
MAX_TIME = 60.0  # [s]
WORKSPACE = Box(lower=np.array([0.15, -0.60, 0.0]), upper=np.array([0.90, 0.60, 0.80]))
STOP_BOX = BoxZone(box=WORKSPACE, hysteresis=0.10)
STOP_DISTANCE = Zone(stop=0.3, resume=0.4)
STILL = 0.01  # [rad/s] no joint faster: the arm stands
LABEL_DELAY = 1  # frames: a mask shows where the person was 0.1 s before
LABEL_ERROR = 2  # [px] that a mask's outline is off by, in or out


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A motion of T states, a period apart: position (T, J), is_stopped (T,); is_complete: the task was done.

    num_interventions: intervals in which a scene row changed the command; relaxed: share of steps with a relaxed row.
    known: the cameras' map during the motion, None without cameras.
    """

    position: Float64
    is_stopped: Bool
    is_complete: bool
    num_interventions: int = 0
    relaxed: float = 0.0
    known: KnownScene | None = None


class TruthField:
    """The distance to stationary primitives, with its gradient."""

    def __init__(self, primitives: Sequence[Primitive]) -> None:
        self._primitives = primitives

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance (Q,) [m] and gradient (Q, 3) at points (Q, 3)."""
        distance, surface = closest_of(self._primitives, points, START_NS)
        away = np.where(np.abs(distance) > 1e-9, distance, 1.0)[:, None]
        return distance, (points - surface) / away


class LiveMap:
    """The map of the camera frames, with the fields of every frame so far."""

    def __init__(self, recording: Recording, config: Config, seed: int) -> None:
        self._recording, self._config, self._model = recording, config, recording.robot
        self._cameras = [camera.name for camera in recording.cameras if camera.is_training]
        reach, base = self._model.reach(), self._model.base_position
        self._fitter = SceneFitter(
            config.scene,
            config.occupancy,
            Box(lower=base - reach, upper=base + reach),
            human=config.human,
            seed=seed,
            threads=1,
        )
        self._labels = LateLabels(seed)
        self._stamps, self._fields, self._seen = list[int](), list[KnownFields](), list[SeenVoxels]()
        self._rows = list[AuditRow]()

    def see(self, index: int, q: Float64) -> DistanceField:
        """Add frame `index` of the cameras, with the arm at q (J,), to the map; return the field for control."""
        frames = [self._labels.on(frame) for frame in self._recording.frames_at(index, q, self._cameras)]
        at_frames = {frame.stamp_ns: q for frame in frames}
        self._rows.append(self._fitter.step(frames, posture_of(self._model, q, at_frames)))
        fitter = self._fitter
        self._stamps.append(frames[0].stamp_ns)
        self._fields.append(splat_fields(fitter.splats(), self._config, 1, fitter.unrepresented))
        self._seen.append(fitter.known_voxels().seen)
        return self._fields[-1].barrier

    def step_at(self, stamp_ns: int) -> SceneStep | None:
        """The two newest fields."""
        if len(self._fields) < 2:
            return None
        return SceneStep(newer=self._fields[-1].barrier, older=self._fields[-2].barrier, seconds=1 / FPS)

    def known(self) -> KnownScene:
        """What was known at each time, for a verdict: that of the one margin to everything, people or things."""
        stamps = tuple(self._stamps)
        voxels = {"voxel": self._config.occupancy.voxel}
        return KnownScene(
            at=fields_at(stamps, lambda index: index, lambda index: self._fields[index]),
            observed=known_space(self._fitter.known_voxels().grid),
            seen_at=lambda stamp: seen_of(self._seen[int(np.searchsorted(stamps, stamp, side="right")) - 1]),
            figures=lambda: voxels | self_mask_metrics(self._rows),
            first_ns=stamps[0],
            stamps_ns=stamps,
            known_ns=stamps,
            cameras=None,
            digests={},
        )


class LateLabels:
    """Masks of people with a segmentation's errors: late, and with inexact outlines."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 5])
        self._masks = dict[str, list[UInt8]]()
        size = 2 * LABEL_ERROR + 1
        self._disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))

    def on(self, frame: RgbdFrame) -> RgbdFrame:
        """The frame with the mask (H, W) of `LABEL_DELAY` frames earlier, grown or shrunk by `LABEL_ERROR`."""
        assert frame.human is not None
        masks = [*self._masks.get(frame.camera, [np.zeros_like(frame.human)] * LABEL_DELAY), frame.human]
        self._masks[frame.camera] = masks[1:]
        change = cv2.dilate if self._rng.random() < 0.5 else cv2.erode
        return replace(frame, human=np.asarray(change(masks[0], self._disc), np.uint8))


def driven(
    model: RobotModel, config: Config, see: Callable[[int, Float64], DistanceField], live: LiveMap | None
) -> Drive:
    """The task in closed loop, in the field that `see` gives at every frame; it ends when done or at MAX_TIME."""
    control = config.control
    q, at, velocity = np.array(HOME), 1, np.zeros(len(HOME))
    goals = [model.frame_pose(np.array(posture), FRAME) for posture in TASK]
    every = round(1 / (FPS * control.period))
    controller = None
    positions, stopped, shaped, relaxed = [], [], [], 0
    for index in range(round(MAX_TIME / control.period)):
        if index % every == 0:
            field = see(index // every, q)
            controller = (
                controller.replace_field(field) if controller else QpIkController(model, control, field, frame=FRAME)
            )
        assert controller is not None
        stamp = START_NS + round(index * control.period * 1e9)
        rate = rate_of(control, model, None if live is None else live.step_at, stamp, q)
        guide = Guide(twist=np.zeros(6), posture=np.array(TASK[at]), velocity=np.zeros(len(q)))
        step = controller.step(q, goals[at], distance_rate=rate, guide=guide, last_velocity=velocity)
        positions.append(q)
        velocity = step.velocity
        stopped.append(bool(np.max(np.abs(velocity)) < STILL))
        shaped.append(any(row.kind == "scene" for row in step.interventions))
        relaxed += bool(step.relaxed)
        if is_at_goal(step.pose_error, control):
            at += 1
            if at == len(TASK):
                break
        q = q + control.period * velocity
    return Drive(
        position=np.array(positions),
        is_stopped=np.array(stopped),
        is_complete=at == len(TASK),
        num_interventions=len(runs_of(np.array(shaped))),
        relaxed=relaxed / len(positions),
        known=None if live is None else live.known(),
    )


def held(model: RobotModel, config: Config, alone: Drive, people: Sequence[Primitive], zone: StopZone) -> Drive:
    """The controller's path without people, stopped by a zone with the true people."""
    period = config.control.period
    stamps = START_NS + np.rint(np.arange(len(alone.position)) * period * 1e9).astype(np.int64)
    run = monitored_standstill(
        model,
        LoggedMotion(stamp_ns=stamps, position=alone.position, velocity=np.gradient(alone.position, period, axis=0)),
        lambda points, stamp: distance_to(people, points, stamp),
        zone,
        start_ns=START_NS,
        period=period,
        max_wait=MAX_TIME,
        max_acceleration=STOP_ACCELERATION,
    )
    return Drive(position=run.position, is_stopped=run.is_stopped, is_complete=run.is_complete)
