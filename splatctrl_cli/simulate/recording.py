"""A simulated recording: records in time order, and the truth."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np

from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Float64, JointState, Record, RgbdFrame, SphereSet, merge_by_stamp
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import visual_urdf
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.arm import UNMODELLED, Capsule, Motion, link_shape
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.render import WIDTH, Camera, DepthNoise, Renderer, StereoDepth
from splatctrl_cli.simulate.truth import distance_to

START_NS = 1_700_000_000_000_000_000
JOINT_RATE = 50  # [Hz]
NOISES: dict[str, DepthNoise | StereoDepth | None] = {
    "none": None,
    "realsense": DepthNoise(),
    "stereo": StereoDepth(width=WIDTH),
}
NUM_BALLS = 100  # that replace a capsule of an unmodelled part, a millimetre apart
OPTICAL_FROM_LINK = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)

Transform = tuple[str, str, Float64]  # parent frame, child frame, T_parent_child (4, 4)


@dataclass(frozen=True, kw_only=True)
class RecordingOptions:
    """Duration [s], frames per second per camera, image size [px], depth noise and seed.

    with_person: a person with masks, instead of the cylinder. is_free: only floor and walls. visitor: x, y, radius
    [m] of the cylinder. color_rays: 0 to 4 per pixel, plus one for depth.
    """

    duration_s: float = 7.0
    fps: float = 5.0
    width: int = 320
    height: int = 240
    noise: str = "realsense"
    seed: int = 0
    with_person: bool = False
    is_free: bool = False
    visitor: tuple[float, ...] = tabletop.VISITOR
    color_rays: int = 4

    def __post_init__(self) -> None:
        text, place = ",".join(f"{value:g}" for value in self.visitor), self.visitor
        is_placed = len(place) == 3 and 0.001 <= place[2] <= 1 and max(map(abs, place[:2])) <= 5
        num_frames = self.duration_s * self.fps
        rules = (
            (0.5 <= self.duration_s <= 600, f"--duration: expected 0.5 to 600 s, got {self.duration_s:g}"),
            (
                0 < self.fps <= 60 and num_frames >= 3,
                f"--fps: expected up to 60 and at least three frames in all, got {self.fps:g}",
            ),
            (16 <= self.width <= 4096, f"--width: expected 16 to 4096 px, got {self.width}"),
            (16 <= self.height <= 4096, f"--height: expected 16 to 4096 px, got {self.height}"),
            (self.noise in NOISES, f"--noise: expected one of {', '.join(NOISES)}, got {self.noise}"),
            (not (self.is_free and self.with_person), "--free: expected no --person, who walks about the table"),
            (is_placed, f"--visitor: expected X,Y within 5 m and RADIUS from 0.001 to 1 m, got {text}"),
            (
                place == tabletop.VISITOR or not (self.with_person or self.is_free),
                "--visitor: expected no --person or --free",
            ),
            (self.seed >= 0, f"--seed: expected 0 or more, got {self.seed}"),
        )
        for is_kept, message in rules:
            refuse_if(not is_kept, message, error=UsageError)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Solids, an arm's motion, and cameras (none: the table's).

    primitives: all solids, `temporary` ones last. has_people: images mask temporary solids.
    """

    primitives: tuple[Primitive, ...]
    temporary: tuple[Primitive, ...]
    motion: Motion
    cameras: tuple[Camera, ...] = ()
    has_people: bool = False

    @classmethod
    def of(cls, options: RecordingOptions) -> "Scene":
        motion = tabletop.arm_motion(options.duration_s)
        if options.is_free:
            return cls(
                primitives=tuple(p for p in tabletop.furniture() if p.name != "table"), temporary=(), motion=motion
            )
        span = round(options.duration_s * 1e9)
        third = (START_NS + span // 3, START_NS + 2 * span // 3)
        num_steps = max(round(options.duration_s * options.fps / 3), 1)
        temporary = (
            tabletop.person(*third, num_steps) if options.with_person else [tabletop.visitor(*third, options.visitor)]
        )
        return cls(
            primitives=(*tabletop.furniture(), *tabletop.objects(), *temporary),
            temporary=tuple(temporary),
            motion=motion,
            has_people=options.with_person,
        )


class Recording:
    """A recorded scene, reproducible by options and scene.

    Images show the robot's visual geometry, if any. The arm respects velocity limits.
    """

    def __init__(
        self,
        options: RecordingOptions,
        robot: RobotModel,
        scene: Scene | None = None,
        unmodelled: tuple[str, ...] = (),
    ) -> None:
        """scene: replaces that of `options`; unmodelled: `UNMODELLED` parts on the arm."""
        self.options, self.robot, self.unmodelled = options, robot, unmodelled
        parts = [(UNMODELLED[name][0], capsule) for name in unmodelled for capsule in UNMODELLED[name][1]]
        self._body = robot if not parts else _add_parts(robot, parts)
        scene = Scene.of(options) if scene is None else scene
        self.start_ns, self.end_ns = START_NS, START_NS + round(options.duration_s * 1e9)
        self.cameras = scene.cameras or tabletop.cameras(options.width, options.height)
        self.primitives, self._temporary, self._has_people = scene.primitives, scene.temporary, scene.has_people
        self._motion = scene.motion.within(robot.velocity_limit)
        seen = visual_urdf(robot.urdf)
        self._shapes = (*seen.shapes, *(link_shape(link, capsule) for link, capsule in parts))
        surface = RobotSurface.of(seen, robot.sphere_set)
        self._meshes = tabletop.arm_meshes(surface) if len(surface.triangles) else None

    def joint_states(self) -> Iterator[JointState]:
        """The arm's states, 50 a second."""
        for index in range(int(self.options.duration_s * JOINT_RATE) + 1):
            position, velocity = self._motion.at(index / JOINT_RATE)
            yield JointState(
                stamp_ns=self.start_ns + index * 10**9 // JOINT_RATE, position=position, velocity=velocity
            )

    def frames(self) -> Iterator[RgbdFrame]:
        """All images in time order, cameras in turn at each stamp."""
        for index in range(int(np.ceil(self.options.duration_s * self.options.fps - 1e-9))):
            yield from self.frames_at(index, self._motion.at(self._offset_ns(index) / 1e9)[0])

    def frames_at(self, index: int, q: Float64, cameras: Collection[str] | None = None) -> Iterator[RgbdFrame]:
        """Images of some cameras (None: all) at frame `index`, at q (J,)."""
        stamp_ns = self.start_ns + self._offset_ns(index)
        poses = self.link_poses(q)
        arm = tabletop.arm_solids(self._shapes, poses)
        meshes = None if self._meshes is None else self._meshes.at(poses)
        passing = [p.at(stamp_ns) for p in self._temporary if p.is_present(stamp_ns)]
        noise = NOISES[self.options.noise]
        for number, renderer in enumerate(self._renderers):
            if cameras is not None and renderer.camera.name not in cameras:
                continue
            color, depth = renderer.image([*arm, *passing], meshes)
            human = None
            if self._has_people:
                without = renderer.depth(arm, meshes)
                human = np.asarray((depth > 0) & ((without == 0) | (depth < without)), np.uint8)
            if noise is not None:
                rng, focal = np.random.default_rng([self.options.seed, number, index]), renderer.camera.intrinsics.fx
                depth = noise.applied(depth, rng, focal=focal)
            yield RgbdFrame(
                stamp_ns=stamp_ns,
                camera=renderer.camera.name,
                color=color,
                depth=depth,
                intrinsics=renderer.camera.intrinsics,
                T_world_camera=renderer.camera.T_world_camera,
                human=human,
            )

    def records(self) -> Iterator[Record]:
        """Joint states and images by stamp, states first."""
        return merge_by_stamp(self.joint_states(), self.frames())

    def link_poses(self, q: Float64) -> dict[str, Float64]:
        """T_world_link (4, 4) by link at q (J,)."""
        return {link: self.robot.frame_pose(q, link) for link in self.robot.urdf.links}

    def static_transforms(self) -> list[Transform]:
        """Frames world -> camN_link -> camN_optical_frame, and world -> the arm's root link."""
        of_cameras = (
            (
                ("world", f"{camera.name}_link", camera.T_world_camera @ OPTICAL_FROM_LINK.T),
                (f"{camera.name}_link", f"{camera.name}_optical_frame", OPTICAL_FROM_LINK),
            )
            for camera in self.cameras
        )
        return [("world", self.robot.urdf.links[0], self.robot.T_world_base), *chain.from_iterable(of_cameras)]

    def link_transforms(self, q: Float64) -> list[Transform]:
        """Parent link -> link, except the root, at q (J,)."""
        poses = self.link_poses(q)
        return [
            (joint.parent, joint.child, invert_transform(poses[joint.parent]) @ poses[joint.child])
            for joint in self.robot.urdf.joints
        ]

    def clearances(self) -> tuple[np.ndarray, Float64]:
        """Stamps (T,) int64 [ns] of joint states, and the arm's true clearance (T,) [m].

        It is the least exact distance of moving collision spheres to the scene; unmodelled parts count to 1 mm.
        """
        states = list(self.joint_states())
        moving, spheres = self._body.moving_spheres, self._body.sphere_set
        clearance = [
            np.min(
                distance_to(self.primitives, self._body.sphere_centers(state.position)[moving], state.stamp_ns)
                - spheres.radii[moving]
            )
            for state in states
        ]
        return np.array([state.stamp_ns for state in states], dtype=np.int64), np.array(clearance)

    def _offset_ns(self, index: int) -> int:
        return round(index * 1e9 / self.options.fps)

    @cached_property
    def _renderers(self) -> list[Renderer]:
        static, rays = self.primitives[: len(self.primitives) - len(self._temporary)], self.options.color_rays
        return [Renderer(camera, static, color_rays=rays) for camera in self.cameras]


def _add_parts(robot: RobotModel, parts: Sequence[tuple[str, Capsule]]) -> RobotModel:
    balls = [(link, c.radius, x) for link, c in parts for x in np.linspace(c.start, c.end, NUM_BALLS)]
    links, radii, centers = zip(*balls, strict=True)
    own = robot.sphere_set
    spheres = SphereSet(
        links=own.links + links,
        centers=np.concatenate([own.centers, centers]),
        radii=np.append(own.radii, radii),
    )
    return RobotModel.from_urdf(robot.urdf.path, spheres, T_world_base=robot.T_world_base)
