"""A run's recording by cameras and joints, with its faults, and its pixels of arm and target."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.geometry import back_project, invert_transform, project, transform_points
from splatctrl_cli.recording.container.mcap_writer import mcap_log
from splatctrl_cli.records import Float32, Float64, JointState, Record, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import Block, Capsule, link_shape
from splatctrl_cli.simulate.primitives import Primitive, Texture
from splatctrl_cli.simulate.recording import JOINT_RATE, OPTICAL_FROM_LINK, START_NS
from splatctrl_cli.simulate.render import Camera, DepthNoise, Renderer
from splatctrl_cli.simulate.tabletop import PALETTE
from tools.hunt.faults import Fault
from tools.hunt.world import DURATION_S, FPS, NS, NUM_FRAMES, World, at_s

PATCH = 3  # [px] over which the noise of depth agrees
RING = 3  # [px]
WRIST = "wrist"  # the camera on the hand
NEAREST = 0.2  # [m] that it measures
MOST_OF_RING = 0.9  # a few pixels beside edges are lost by any camera
ARM_TEXTURE = Texture(pattern="checks", feature=0.05, dark=PALETTE["shell"][0], bright=PALETTE["shell"][1], seed=20)
TRACE = 0.10  # [m] by which depth lies behind what is there, so that other cameras contradict it
SAME_SURFACE = 0.02  # [m] two cameras see the same place


@dataclass(frozen=True, kw_only=True)
class Shown:
    """Pixels (C, F) with depth, as recorded, of the arm, of the target and in all. `target_outline`: the target's
    pixels with or without depth. `target_hole`: outline pixels, if depth of other objects surrounds the outline. All
    are 0 if the image is missing. overlap (C, C): pixels of one camera's first image that another camera sees, too.
    stamps (F,) [ns]: true times of the images.
    """

    cameras: tuple[str, ...]
    stamps: np.ndarray
    arm: np.ndarray
    target: np.ndarray
    target_outline: np.ndarray
    target_hole: np.ndarray
    depth: np.ndarray
    overlap: np.ndarray


class Recorder:
    """Renders one world under one fault."""

    def __init__(self, world: World, fault: Fault, model: RobotModel, seed: tuple[int, ...]) -> None:
        self._world, self._fault, self._model, self._seed = world, fault, model, seed
        self._renderers = [Renderer(camera, world.things, color_rays=0) for camera in world.cameras]
        self._names = tuple(c.name for c in (*world.cameras, *([world.wrist] if world.wrist else [])))
        shape = (len(self._names), NUM_FRAMES)
        self._arm, self._target, self._outline, self._hole, self._depth = (
            np.zeros(shape, dtype=np.int64) for _ in range(5)
        )
        self._newest: dict[int, tuple[np.ndarray, Float32]] = {}  # colour and depth of each camera's last image
        self._first: list[Float32] = [np.zeros((0, 0), np.float32)] * len(self._names)

    def write(self, path: Path) -> Shown:
        """Write the log, and say what it shows."""
        records = sorted(self._records(), key=_order)
        with mcap_log(path) as log:
            log.add_transforms(START_NS, self._camera_transforms(), is_static=True)
            for record in records:
                if isinstance(record, JointState):
                    log.add_joint_state(record, self._model.joint_names)
                    continue
                if record.camera == WRIST:
                    pose = record.T_world_camera @ OPTICAL_FROM_LINK.T
                    log.add_transforms(record.stamp_ns, [("world", f"{WRIST}_link", pose)], is_static=False)
                log.add_frame(record)
        return Shown(
            cameras=self._names,
            stamps=np.array([at_s(index / FPS) for index in range(NUM_FRAMES)]),
            arm=self._arm,
            target=self._target,
            target_outline=self._outline,
            target_hole=self._hole,
            depth=self._depth,
            overlap=self._overlap(),
        )

    def _records(self) -> Iterator[Record]:
        yield from self._states()
        for index in range(NUM_FRAMES):
            stamp = at_s(index / FPS)
            arm = self._arm_solids(self._world.positions(np.array([stamp]))[0])
            targets = [p.at(stamp) for p in self._world.targets if p.is_present(stamp)]
            for number, renderer in enumerate(self._renderers_at(stamp)):
                if (renderer.camera.name, index) not in self._fault.lost:
                    yield self._frame(number, renderer, index, arm, targets)

    def _renderers_at(self, stamp_ns: int) -> list[Renderer]:
        """Renderers of the stationary cameras, and of the camera on the hand at its pose of a stamp."""
        wrist = self._world.wrist
        if wrist is None:
            return self._renderers
        T_world_hand = self._model.frame_pose(self._world.positions(np.array([stamp_ns]))[0], "hand")
        there = replace(wrist, T_world_camera=T_world_hand @ wrist.T_world_camera)
        return [*self._renderers, Renderer(there, self._world.things, color_rays=0)]

    def _states(self) -> Iterator[JointState]:
        gap = self._fault.lost_states
        for index in range(int(DURATION_S * JOINT_RATE) + 1):
            second = index / JOINT_RATE
            if gap is not None and gap[0] <= second < gap[1]:
                continue
            position, velocity = self._world.motion.at(second)
            still = replace(self._fault, offset=(0.0,) * len(position))
            yield JointState(
                stamp_ns=START_NS + index * NS // JOINT_RATE,
                position=self._fault.logged(position[None])[0],
                velocity=still.logged(velocity[None])[0],
            )

    def _frame(
        self, number: int, renderer: Renderer, index: int, arm: list[Primitive], targets: list[Primitive]
    ) -> RgbdFrame:
        fault, camera = self._fault, renderer.camera
        rng = np.random.default_rng([*self._seed, number, index, 1])
        color, exact = renderer.image([*arm, *targets])
        without_target, without_arm = renderer.depth(arm), renderer.depth(targets)
        is_target, is_arm = _nearer(exact, without_target), _nearer(exact, without_arm)
        measured = self._measured(exact, camera, (*self._seed, number, index), rng)
        measured = np.where(is_target & _lost(fault, exact.shape, rng), 0, measured)
        if fault.is_beyond:
            farther = measured + fault.beyond if fault.instead is None else np.full_like(measured, fault.instead)
            measured = np.where(is_target & (measured > 0), farther, measured)
        if camera.name == WRIST:
            measured = np.where(measured < NEAREST, 0, measured)
        if (camera.name, index) in fault.blind:
            measured = np.zeros_like(measured)
        wrong = measured * fault.depth_scale.get(camera.name, 1.0) + fault.depth_bias.get(camera.name, 0.0)
        depth = np.where(measured > 0, np.maximum(wrong, 0), 0).astype(np.float32)
        if fault.repeated is not None and index >= fault.repeated:
            before_color, depth = self._newest[number]
            color = before_color if fault.repeats_color else color
        self._newest[number] = color, depth
        is_told = (depth > 0) & (fault.repeated is None or index < fault.repeated)
        is_of_target = is_target & is_told
        if fault.is_beyond:  # a ray through the table is the trace
            behind = renderer.depth([])
            is_of_target &= (behind > 0) & (depth > behind + TRACE)
        self._arm[number, index] = np.count_nonzero(is_arm & is_told)
        self._target[number, index] = np.count_nonzero(is_of_target)
        self._depth[number, index] = np.count_nonzero(is_told)
        self._outline[number, index] = np.count_nonzero(is_target)
        if _is_enclosed(is_target, (depth > 0) & ~is_arm):
            self._hole[number, index] = np.count_nonzero(is_target)
        if index == 0:
            self._first[number] = exact
        people = [target for target in targets if target.name in self._world.people]
        human = None
        if self._world.people:
            rest = [target for target in targets if target.name not in self._world.people]
            human = (_nearer(exact, renderer.depth([*arm, *rest])) & bool(people)).astype(np.uint8)
        return RgbdFrame(
            stamp_ns=at_s(index / FPS) + round(fault.clock.get(camera.name, 0.0) * NS),
            camera=camera.name,
            color=color,
            depth=depth,
            intrinsics=camera.intrinsics,
            T_world_camera=fault.recorded_pose(camera.name, camera.T_world_camera),
            human=human,
        )

    def _measured(self, exact: Float32, camera: Camera, seed: tuple[int, ...], rng: np.random.Generator) -> Float32:
        """Depth (H, W) [m] as the camera measures it, holes and edges of the fault included."""
        fault, stereo = self._fault, self._world.body.depth
        noise = DepthNoise(patch=PATCH, edge=np.inf, max_range=fault.max_range)
        nearly = noise.applied(exact, np.random.default_rng(seed))
        with_edges = replace(noise, edge=fault.edge).applied(exact, np.random.default_rng(seed))
        nearly = np.where(rng.random(exact.shape) < fault.edge_share, with_edges, nearly)
        if stereo is None:
            return nearly
        measured = stereo.applied(exact, np.random.default_rng(seed), focal=camera.intrinsics.fx)
        is_lost = (measured > fault.max_range) | ((nearly == 0) & (fault.edge_share == 1.0))
        return np.where(is_lost, 0, measured).astype(np.float32)

    def _arm_solids(self, q: Float64) -> list[Primitive]:
        tools = [] if self._world.tool is None else [("hand", self._world.tool)]
        solids = [*self._world.body.solids, *tools]
        poses = {link: self._model.frame_pose(q, link) for link in dict.fromkeys(link for link, _ in solids)}
        return [_solid(link, shape, poses[link]) for link, shape in solids]

    def _camera_transforms(self) -> list[tuple[str, str, Float64]]:
        transforms: list[tuple[str, str, Float64]] = [("world", "link0", np.eye(4))]
        for camera in self._world.cameras:
            T_world_camera = self._fault.recorded_pose(camera.name, camera.T_world_camera)
            transforms.append(("world", f"{camera.name}_link", T_world_camera @ OPTICAL_FROM_LINK.T))
            transforms.append((f"{camera.name}_link", f"{camera.name}_optical_frame", OPTICAL_FROM_LINK))
        if self._world.wrist is not None:
            transforms.append((f"{WRIST}_link", f"{WRIST}_optical_frame", OPTICAL_FROM_LINK))
        return transforms

    def _overlap(self) -> np.ndarray:
        cameras = self._world.cameras
        out = np.zeros((len(self._names), len(self._names)), dtype=np.int64)  # of that on the hand none is counted
        for i, camera in enumerate(cameras):
            points = transform_points(camera.T_world_camera, _points(camera, self._first[i]))
            for j, other in enumerate(cameras):
                if i != j:
                    out[i, j] = _num_seen(other, self._first[j], points)
        return out


def _points(camera: Camera, depth: Float32) -> Float64:
    return np.asarray(back_project(camera.intrinsics, depth)[depth > 0], dtype=np.float64).reshape(-1, 3)


def _num_seen(camera: Camera, depth: Float32, points_world: Float64) -> int:
    """How many points (Q, 3) a camera's depth image shows."""
    points = transform_points(invert_transform(camera.T_world_camera), points_world)
    points = points[points[:, 2] > 0.05]
    pixels = np.rint(project(camera.intrinsics, points)).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < depth.shape[::-1]), axis=1)
    measured = depth[pixels[inside, 1], pixels[inside, 0]]
    return int(np.count_nonzero(np.abs(measured - points[inside, 2]) < SAME_SURFACE))


def _nearer(depth: Float32, without: Float32) -> np.ndarray:
    return np.asarray((depth > 0) & ((without == 0) | (depth < without)))


def _is_enclosed(inner: np.ndarray, around: np.ndarray) -> bool:
    """True if pixels `inner` (H, W) avoid the image border, and most pixels within `RING` of them are `around`."""
    if not inner.any() or inner[[0, -1]].any() or inner[:, [0, -1]].any():
        return False
    ring = cv2.dilate(inner.astype(np.uint8), np.ones((2 * RING + 1, 2 * RING + 1), np.uint8)).astype(bool) & ~inner
    return bool(np.count_nonzero(ring & around) >= MOST_OF_RING * np.count_nonzero(ring))


def _lost(fault: Fault, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Pixels (H, W) that a dark or shiny surface loses: speckled, or in blobs."""
    if fault.dark == 0:
        return np.zeros(shape, dtype=bool)
    if fault.speckle:
        return np.asarray(rng.random(shape) < fault.dark)
    coarse = rng.random((shape[0] // 6 + 1, shape[1] // 6 + 1)) < fault.dark
    return np.asarray(np.repeat(np.repeat(coarse, 6, axis=0), 6, axis=1)[: shape[0], : shape[1]])


def _solid(link: str, shape: Capsule | Block, T_world_link: Float64) -> Primitive:
    solid = link_shape(link, shape)
    T = T_world_link @ solid.T_link_shape
    return Primitive(name=link, kind=solid.kind, size=solid.size, T_world_shape=T, texture=ARM_TEXTURE)


def _order(record: Record) -> tuple[int, int, str]:
    is_frame = isinstance(record, RgbdFrame)
    return record.stamp_ns, int(is_frame), record.camera if isinstance(record, RgbdFrame) else ""
