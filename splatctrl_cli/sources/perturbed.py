"""A recording whose depth is noisier and whose cameras stand elsewhere than recorded: its frames as they are read."""

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.logs.joint_topics import JointTopics
from splatctrl_cli.logs.source_options import PERTURB
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.logs.stored_frame import FrameSource, StoredFrame, decoded
from splatctrl_cli.records import Float32, Float64, JointState, LossReport, Record

LIMITS = {"depth-noise": 1.0, "pose-error": 10.0, "pose-turn": 180.0, "seed": 2**31 - 1}  # m at 1 m, m, degrees


@dataclass(frozen=True, kw_only=True)
class Perturbation:
    """What is done to a recording; all of it is drawn from `seed`, so that twice the size is twice the same error.

    depth_noise: standard deviation of each pixel's depth at 1 m [m], growing with the square of the depth, as of a
    stereo camera. pose_error [m], pose_turn [degrees]: how far each camera is moved in one direction of its own, and
    turned about one axis of its own, the same in all its frames.
    """

    depth_noise: float = 0.0
    pose_error: float = 0.0
    pose_turn: float = 0.0
    seed: int = 0

    @classmethod
    def of(cls, given: Mapping[str, float]) -> "Perturbation | None":
        """From values by name; None for one that does nothing. Raises UsageError for another name or value."""
        for name, value in given.items():
            if name not in LIMITS:
                raise UsageError(f"--perturb {name}: expected one of {', '.join(LIMITS)}", remedy="leave it out")
            if not 0 <= value <= LIMITS[name] or (name == "seed" and value != int(value)):
                raise UsageError(f"--perturb {name}: expected 0 to {LIMITS[name]:g}, got {value:g}")
        made = cls(**{name.replace("-", "_"): int(v) if name == "seed" else v for name, v in given.items()})  # type: ignore[arg-type]
        return made if made.depth_noise or made.pose_error or made.pose_turn else None

    def depth(self, camera: str, stamp_ns: int, depth: Float32) -> Float32:
        """A depth image (H, W) [m] with noise; what had no depth, or has none left, is 0."""
        noise = self._generator(camera, stamp_ns).standard_normal(depth.shape, np.float32)
        noisy = depth + np.float32(self.depth_noise) * depth**2 * noise
        return np.where((depth > 0) & (noisy > 0), noisy, np.float32(0.0)).astype(np.float32)

    def pose(self, camera: str, T_world_camera: Float64) -> Float64:
        """T_world_camera (4, 4) of a camera that stands elsewhere."""
        way, axis = self._generator(camera).standard_normal((2, 3))
        half = np.radians(self.pose_turn) / 2
        quat_xyzw = [*(np.sin(half) * axis / np.linalg.norm(axis)), np.cos(half)]
        return np.asarray(T_world_camera @ transform_from(self.pose_error * way / np.linalg.norm(way), quat_xyzw))

    def words(self) -> str:
        """As on the command line."""
        values = {"depth-noise": self.depth_noise, "pose-error": self.pose_error, "pose-turn": self.pose_turn}
        return ",".join(f"{name}={value!r}" for name, value in {**values, "seed": self.seed}.items() if value)

    def _generator(self, camera: str, stamp_ns: int = 0) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(camera.encode()), stamp_ns % 2**63])


class PerturbedSource:
    """Records of another source, perturbed; nothing is written."""

    def __init__(self, source: FrameSource, perturbation: Perturbation) -> None:
        self.inner, self._perturbation = source, perturbation
        self.name, self.cameras, self.joint_names = source.name, source.cameras, source.joint_names
        self.has_clock, self.world_frame = source.has_clock, source.world_frame

    @property
    def states(self) -> StateColumns:
        """The joint states, as recorded."""
        return self.inner.states

    @property
    def joint_topics(self) -> JointTopics | None:
        """The topics of the joint states, where the source knows them."""
        found = getattr(self.inner, "joint_topics", None)
        return found if isinstance(found, JointTopics) else None

    @property
    def loss(self) -> LossReport:
        """That of the source, with a note."""
        loss = self.inner.loss
        return replace(loss, notes=[*loss.notes, f"perturbed: {self._perturbation.words()}"])

    def records(self) -> Iterator[Record]:
        return decoded(self.stored())

    def stored(self) -> Iterator[StoredFrame | JointState]:
        for item in self.inner.stored():
            yield self._perturbed(item) if isinstance(item, StoredFrame) else item

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Stamp [ns], camera and T_world_camera (4, 4) of each frame, by stamp."""
        for stamp_ns, camera, T in self.inner.poses():
            yield stamp_ns, camera, self._perturbation.pose(camera, T)

    def digests(self) -> dict[str, str]:
        """sha256 of the source's files, and what is done to them."""
        words = self._perturbation.words()
        return {**self.inner.digests(), f"{PERTURB}{words}": words}

    def _perturbed(self, stored: StoredFrame) -> StoredFrame:
        asked, T = self._perturbation, self._perturbation.pose(stored.camera, stored.T_world_camera)
        if not asked.depth_noise:
            return replace(stored, T_world_camera=T)
        return replace(
            stored,
            T_world_camera=T,
            read_depth=lambda: asked.depth(stored.camera, stored.stamp_ns, stored.depth),
            depth_unit=None,
            depth_file=None,
        )


def perturbed(source: FrameSource, given: Mapping[str, float]) -> FrameSource:
    """The source, with what is to be done to it. Raises UsageError as `Perturbation.of`."""
    perturbation = Perturbation.of(given)
    return source if perturbation is None else PerturbedSource(source, perturbation)
