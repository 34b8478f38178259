"""One run: drawn from its seed, recorded, reconstructed, replayed, and its verdict compared with the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.errors import SplatCtrlError
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.replay.replay import ReplayResult, replay
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Box, Float64, Intrinsics
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import Motion, arm_spheres_yaml, arm_urdf
from splatctrl_cli.simulate.primitives import Primitive, Track
from splatctrl_cli.simulate.render import Camera
from tools.hunt.body import draw_body
from tools.hunt.clearance import TOLERANCE, Positions, TrueArm, interpolated, least_clearance
from tools.hunt.families import FAMILIES, LATER, NEWEST, ORDER, Draft
from tools.hunt.faults import spheres_yaml
from tools.hunt.observability import MARGIN, TOLERATED, Observable, observable
from tools.hunt.outcome import Word, refused, word_of
from tools.hunt.recording import Recorder, Shown
from tools.hunt.world import (
    BOX,
    DURATION_S,
    TURN,
    Made,
    World,
    at_s,
    draw_cameras,
    draw_motion,
    draw_things,
    placed,
    wrist_camera,
)

FIRST_OF_ALL = 100  # the first seed whose campaigns have all families
FIRST_OF_NEWEST = 500  # the same of those that came last
BEFORE_CAMERAS = np.array([0.32, 0.0, 0.27])  # [m] about where they look
MODES = ("audit", "closed-loop")
CLOSED_SHARE = 0.3
SPLATS = 3000  # hold every surface of these scenes
SHARES = {"benign": (0.22, 0.10), "still": (0.22, 0.10)}  # of targets drawn into contact, and inside the margin
OTHER_SHARES = (0.62, 0.16)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One planned run. seed: of the campaign; index: within the campaign."""

    seed: int
    index: int
    family: str
    draft: Draft
    world: World
    mode: str


@dataclass(frozen=True, kw_only=True)
class Row:
    """Result of one run: the verdict, its first reason, and the truth [m].

    robot: its body in words; spread, fattening [px]: of its stereo depth, 0 for nearly exact depth. only: the only
    limit of evidence that prevents safe.
    """

    seed: int
    index: int
    family: str
    kind: str
    strength: float
    mode: str
    outcome: str
    clearance: float
    observable: bool
    rule: str
    reason: str
    robot: str = ""
    spread: float = 0.0
    fattening: float = 0.0
    only: str = ""

    @property
    def name(self) -> str:
        """Seed and index, by which it is drawn again."""
        return f"{self.seed}/{self.index}"

    @property
    def is_false_green(self) -> bool:
        """Safe by the verdict, and not by the truth."""
        return self.outcome == "safe" and self.clearance < MARGIN - TOLERATED - TOLERANCE


def family_of(seed: int, index: int) -> str:
    """Families by turns."""
    left_out = (*(LATER if seed < FIRST_OF_ALL else ()), *(NEWEST if seed < FIRST_OF_NEWEST else ()))
    order = [name for name in ORDER if name not in left_out]
    return order[index % len(order)]


def draw(seed: int, index: int, model: RobotModel) -> Trial:
    """The run of a seed and an index; the same for the same two."""
    rng, family = np.random.default_rng([seed, index]), family_of(seed, index)
    contact, margin = SHARES.get(family, OTHER_SHARES)
    wish, body = rng.random(), draw_body(seed, index, family)
    for _ in range(60):
        draft = FAMILIES[family](rng)
        arm = TrueArm(model, draft.tool, body)
        everywhere = draw_cameras(rng, body.width)
        motion = draw_motion(rng, model, arm, everywhere, draft.turn * TURN)
        cameras = tuple(_seen_from(camera, draft) for camera in everywhere if camera.name in draft.cameras)
        if wish < contact:
            clearance = -float(rng.uniform(0.001, 0.025))
        else:
            clearance = float(rng.uniform(0.0, 0.02) if wish < contact + margin else rng.uniform(0.045, 0.15))
        second = draft.second if draft.second is not None else float(rng.uniform(1.2, 2.7))
        if draft.carried is not None:
            targets: Made = (_carried(draft, motion, model, body.palm),)
        else:
            found = placed(
                rng, draft.make, motion, arm, cameras,
                clearance=clearance, second=second, towards=_towards(draft, cameras), from_link=draft.from_link,
            )  # fmt: skip
            start = motion.at(0.0)[0][None]
            if found is None or (
                not draft.touches_first and arm.clearances(found, np.array([at_s(0.0)]), start)[0] < 0.04
            ):
                continue
            targets = found
        world = World(
            motion=motion,
            things=draw_things(rng, motion, arm),
            targets=targets,
            cameras=cameras,
            wrist=wrist_camera(body.width) if draft.has_wrist else None,
            tool=draft.tool,
            body=body,
            people=draft.people,
        )
        is_driven = (rng.random() < CLOSED_SHARE or draft.only_closed) and not draft.only_audit
        mode = MODES[int(is_driven)]
        return Trial(seed=seed, index=index, family=family, draft=draft, world=world, mode=mode)
    raise RuntimeError(f"{seed}/{index}: no scene found")


def run(seed: int, index: int, device: str = "cpu") -> Row:
    """Draw, record, judge and compare a run; fit its map on `device`."""
    with TemporaryDirectory(prefix="hunt") as name:
        folder = Path(name)
        model = true_robot(folder)
        trial = draw(seed, index, model)
        body = trial.world.body
        arm = TrueArm(model, trial.world.tool, body)
        shown = record(trial, model, folder)
        evidence = _evidence(trial, arm, shown)
        outcome, result = _judged(trial, folder, device)
        clearance = _true_clearance(trial, arm, result)
    return Row(
        seed=seed,
        index=index,
        family=trial.family,
        kind=trial.draft.kind,
        strength=trial.draft.strength,
        mode=trial.mode,
        outcome=outcome.word,
        clearance=clearance,
        observable=evidence.holds,
        rule=evidence.rule,
        reason=outcome.reason.replace(f"{folder}/", ""),
        robot=body.words,
        spread=0.0 if body.depth is None else body.depth.spread,
        fattening=0.0 if body.depth is None else body.depth.fattening[1],
        only=outcome.only,
    )


def true_robot(folder: Path) -> RobotModel:
    """The arm as it is, its files written to a folder."""
    urdf, spheres = folder / "true.urdf", folder / "true.yaml"
    urdf.write_text(arm_urdf(), encoding="utf-8")
    spheres.write_text(arm_spheres_yaml(), encoding="utf-8")
    return RobotModel.from_urdf(urdf, spheres)


def record(trial: Trial, model: RobotModel, folder: Path) -> Shown:
    """Write the tool's inputs: log.mcap, robot.urdf, robot.yaml."""
    fault, rng = trial.draft.fault, np.random.default_rng([trial.seed, trial.index, 1])
    (folder / "robot.urdf").write_text(fault.urdf(trial.world.body.shapes), encoding="utf-8")
    (folder / "robot.yaml").write_text(spheres_yaml(fault.spheres(rng)), encoding="utf-8")
    recorder = Recorder(trial.world, fault, model, (trial.seed, trial.index, 2))
    return recorder.write(folder / "log.mcap")


def config_of(trial: Trial) -> Config:
    """The defaults, with fewer iterations, because the images are small."""
    config = Config()
    splats = trial.draft.fault.max_splats or SPLATS
    scene = replace(
        config.scene,
        max_splats=splats,
        first_iterations=50,
        iterations_per_step=8,
        window=4,
        checkpoint_period=86400.0,
    )
    control = replace(config.control, solver="daqp", pose_gain=4.0, max_time=DURATION_S)
    config = replace(config, scene=scene, control=control)
    for key, value in trial.draft.settings:
        section, _, name = key.partition(".")
        old = getattr(config, section)
        kind = type(getattr(old, name))
        config = replace(config, **{section: replace(old, **{name: kind(round(value) if kind is int else value)})})
    return config


def _judged(trial: Trial, folder: Path, device: str = "cpu") -> tuple[Word, ReplayResult | None]:
    """The chain's own word; None beside a refusal."""
    config, log, robot = config_of(trial), folder / "log.mcap", (folder / "robot.urdf", folder / "robot.yaml")
    try:
        reconstruct(
            ReconstructRequest(
                source=open_source(log),
                out=folder / "scene",
                config=config,
                urdf=robot[0],
                spheres=robot[1],
                box=box_of(trial),
                threads=1,
                device=device,
            )
        )
        request = ReplayRequest(
            log=log,
            urdf=robot[0],
            spheres=robot[1],
            out=folder / "replay",
            config=config,
            options=SourceOptions(),
            scene=folder / "scene",
            latency=trial.draft.fault.latency,
            mode=trial.mode,
            worst_frames=0,
            threads=1,
        )
        if trial.draft.max_map_age is not None:
            request = replace(request, max_map_age=trial.draft.max_map_age)
        result = replay(request)
        return word_of(result.verdict, result.replay.trace, result.replay.margin), result
    except SplatCtrlError as error:
        return refused(error, folder), None


def _true_clearance(trial: Trial, arm: TrueArm, result: ReplayResult | None) -> float:
    """The least clearance [m] over the judged motion. An audit's begins at the first judged state and ends with the
    log; a closed loop's is the driven motion. If nothing was judged, it is the recorded motion.
    """
    first, last = at_s(0.0), at_s(DURATION_S)
    positions: Positions = trial.world.positions
    if result is not None:
        stamps = result.replay.trace.stamp_ns
        first = int(stamps[0])
        if trial.mode == "closed-loop":
            last = int(stamps[-1])
            positions = interpolated(stamps, trial.draft.fault.true_of(result.replay.trace["q"]))
    return least_clearance(arm, trial.world.primitives, positions, first, max(first, last))[0]


def _evidence(trial: Trial, arm: TrueArm, shown: Shown) -> Observable:
    world = trial.world
    _, least_ns = least_clearance(arm, world.targets, world.positions, at_s(0.0), at_s(DURATION_S))
    stamps = shown.stamps.astype(np.int64)
    return observable(
        trial.draft,
        world,
        shown,
        frame_clearance=arm.clearances(world.targets, stamps, world.positions(stamps)),
        least_ns=least_ns,
        is_audit=trial.mode == "audit",
    )


def _towards(draft: Draft, cameras: Sequence[Camera]) -> Float64 | None:
    """The place (3,) [m] from which the target comes; None for anywhere."""
    if draft.towards == "behind":  # as far on the other side as the cameras are
        middle = np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0)
        return np.asarray(BEFORE_CAMERAS + 3.0 * (BEFORE_CAMERAS - middle))
    return np.array([100.0, 0.0, 0.5]) if draft.towards == "x" else None


def box_of(trial: Trial) -> Box:
    """The workspace that the user gives."""
    if trial.draft.box_gap is None:
        return BOX
    (plate,) = trial.world.targets
    face = plate.T_world_shape[0, 3] - plate.size[0] / 2
    return Box(lower=BOX.lower, upper=np.array([face - trial.draft.box_gap, *BOX.upper[1:]]))


def _carried(draft: Draft, motion: Motion, model: RobotModel, palm: float) -> Primitive:
    """The target in the hand, 3 mm into the palm, along the hand's z axis."""
    assert draft.carried is not None
    radius, length = draft.carried
    (solid,) = draft.make(np.zeros(3))
    seconds = np.arange(0.0, DURATION_S + 0.02, 0.02)
    T_hand_target = pose_at([0.0, 0.0, palm + radius + length / 2 - 0.003])
    poses = np.array([model.frame_pose(motion.at(float(s))[0], "hand") @ T_hand_target for s in seconds])
    track = Track(stamp_ns=np.array([at_s(float(s)) for s in seconds]), T_world_shape=poses)
    return replace(solid, T_world_shape=poses[0], track=track)


def _seen_from(camera: Camera, draft: Draft) -> Camera:
    """The camera with the draft's lens, moved back along its axis by `distance` - 1 [m]."""
    k, T = camera.intrinsics, camera.T_world_camera.copy()
    T[:3, 3] -= (draft.distance - 1.0) * T[:3, 2]
    zoom = draft.zoom
    lens = Intrinsics(fx=zoom * k.fx, fy=zoom * k.fy, cx=k.cx, cy=k.cy, width=k.width, height=k.height)
    return replace(camera, intrinsics=lens, T_world_camera=T)
