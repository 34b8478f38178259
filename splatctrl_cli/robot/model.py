"""A robot arm: forward kinematics and Jacobians of its collision spheres and frames.

Meshes may be missing. S spheres, J joints, T postures.
"""

from bisect import bisect_right
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pinocchio

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if, require
from splatctrl_cli.kernels.chain import PRISMATIC, REVOLUTE, Chain
from splatctrl_cli.records import Bool, Box, Float64, Floats, Index, SphereSet
from splatctrl_cli.robot.coverage import CoverageReport, deficit_by_sphere
from splatctrl_cli.robot.self_model import SelfModel
from splatctrl_cli.robot.sphere_files import (
    RENAMED,
    add_boxes,
    are_links_renamed,
    lever_arms,
    match_links,
    read_spheres,
)
from splatctrl_cli.robot.sphere_fit import default_spheres
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf


class RobotModel:
    """Kinematics, limits and collision spheres of one arm; world frame, SI units, float64.

    joint_names, lower, upper [rad or m], velocity_limit [1/s] (J,); middle (J,): of the limits, 0 without limits;
    base_position (3,) [m]; sphere_set: in link frames; frame_names: links that `frame_pose` knows; left_out:
    sphere-file links missing from the URDF; bare_links: URDF links with a body but no sphere; coverage: None if
    unknown, for the reason coverage_unknown; sphere_deficit (S,) [m]: `deficit_by_sphere`, NaN if unknown; locked:
    values of locked fingers.
    """

    def __init__(
        self,
        urdf: UrdfFile,
        model: pinocchio.Model,
        spheres: SphereSet,
        T_world_base: Float64 | None,
        left_out: Sequence[str],
        *,
        are_links_renamed: bool,
        packages: Sequence[Path] = (),
        locked: Mapping[str, float] | None = None,
    ) -> None:
        self._model = model
        self.urdf = urdf
        self._given_base = T_world_base
        self.T_world_base: Float64 = np.eye(4) if T_world_base is None else T_world_base
        self.base_position: Float64 = np.array(self.T_world_base[:3, 3])
        self.joint_names: tuple[str, ...] = tuple(str(name) for name in model.names)[1:]
        self.sphere_set = spheres
        self.left_out = tuple(left_out)
        self.are_links_renamed = are_links_renamed
        self.bare_links = tuple(link for link in urdf.solid_links if link not in spheres.links)
        self.coverage: CoverageReport | None = None
        self.coverage_unknown = "the collision geometry was not read"
        self.sphere_deficit: Float64 = np.full(len(spheres.radii), np.nan)
        self._surface: RobotSurface | None = None
        self.self_model: SelfModel | None = None
        self._surfaces: dict[int, RobotSurface] = {}  # by the number of earlier `changes`
        self._packages = packages
        self.locked = dict(locked or {})
        self._chosen_pairs: Index | None = None
        self._allowance: Float64 | None = None
        self._is_wrapped = np.array([joint.nq == 2 for joint in model.joints][1:], dtype=bool)
        rows = [joint.idx_q for joint in model.joints][1:]
        self.lower: Float64 = np.where(self._is_wrapped, -np.inf, model.lowerPositionLimit[rows])
        self.upper: Float64 = np.where(self._is_wrapped, np.inf, model.upperPositionLimit[rows])
        limited = np.isfinite(self.lower) & np.isfinite(self.upper)
        lower, upper = np.where(limited, self.lower, 0), np.where(limited, self.upper, 0)
        self.middle: Float64 = np.where(limited, (lower + upper) / 2, 0.0)
        self.velocity_limit: Float64 = np.array(model.velocityLimit, dtype=np.float64)
        self._frames = {
            str(frame.name): index
            for index, frame in enumerate(model.frames)
            if frame.type == pinocchio.FrameType.BODY
        }
        self.frame_names = tuple(link for link in urdf.links if link in self._frames)
        frames = [self._model.frames[self._frame(link)] for link in self.sphere_set.links]
        offsets = [
            frame.placement.rotation @ center + frame.placement.translation
            for frame, center in zip(frames, self.sphere_set.centers, strict=True)
        ]
        self._sphere_joint: Index = np.array([frame.parentJoint for frame in frames], dtype=np.int64)
        self._sphere_offset: Float64 = np.array(offsets, dtype=np.float64)
        self.chain = self._as_chain()
        postures = [self.middle + np.sin(np.arange(1, self.num_joints + 1) * (k + 1)) for k in range(3)]
        self.moving_spheres: Bool = np.asarray(
            np.max([np.abs(self.spheres_at(q)[1]).max(axis=(1, 2)) for q in postures], axis=0) > 1e-9
        )

    @classmethod
    def from_urdf(
        cls,
        urdf: Path | UrdfFile,
        spheres: Path | SphereSet | None = None,
        *,
        T_world_base: Float64 | None = None,
        locked: Mapping[str, float] | None = None,
        packages: Sequence[Path] = (),
    ) -> "RobotModel":
        """Build the robot of a URDF, with given spheres or `default_spheres`.

        T_world_base (4, 4): of the root link (default: tf's, see `moved_by`, else the world's origin). locked: joints
        fixed at values [rad or m], with mimics. packages: folders for ``package://``, as in `read_solids`.
        Raises InputError.
        """
        file = urdf if isinstance(urdf, UrdfFile) else read_urdf(urdf)
        with refuse_faults(f"{file.path}: not a URDF that can be built", ValueError, RuntimeError):
            model = pinocchio.buildModelFromXML(file.text)
        model = _without(model, file.add_followers(locked or {}), file.path)
        if spheres is None:
            spheres = default_spheres(file, packages)
        unmatched = spheres if isinstance(spheres, SphereSet) else read_spheres(spheres)
        sphere_set, left_out = match_links(unmatched, file, "sphere set" if unmatched is spheres else str(spheres))
        return cls(
            file,
            model,
            sphere_set,
            T_world_base,
            left_out,
            are_links_renamed=are_links_renamed(unmatched, file),
            packages=packages,
        )

    def moved_by(
        self, names: Sequence[str], frames: Mapping[str, Float64 | None] = MappingProxyType({})
    ) -> "RobotModel":
        """Robot for a log of these joints and tf frames.

        frames: T_world_frame (4, 4) [m], None if tf moves it. The root is where tf has it, unless T_world_base was
        given. Unmoved fingers and their mimics are locked in the middle of their limits (`locked`). Raises InputError
        if tf moves the root.
        """
        root, base = self.urdf.root, self._given_base
        refuse_if(
            base is None and root in frames and frames[root] is None,
            f"tf moves '{root}', the robot's root, in the world frame; expected a fixed robot",
            remedy=f"give --world-frame {root}, or --base with its pose",
        )
        base = frames.get(root) if base is None else base
        fingers = [name for name in self.urdf.fingers(names) if name in self.joint_names]
        if not fingers and base is self._given_base:
            return self
        middle = dict(zip(self.joint_names, self.middle, strict=True))
        led = {joint.name for joint in self.urdf.joints if joint.mimic is not None and joint.mimic[0] in fingers}
        locked = self.urdf.add_followers({name: float(middle[name]) for name in fingers if name not in led})
        return RobotModel(
            self.urdf,
            _without(self._model, locked, self.urdf.path),
            self.sphere_set,
            base,
            self.left_out,
            are_links_renamed=self.are_links_renamed,
            packages=self._packages,
            locked=self.locked | {name: locked[name] for name in self.joint_names if name in locked},
        )

    def carrying(self, boxes: Sequence[tuple[str, Box]]) -> "RobotModel":
        """Robot whose spheres and surface include carried boxes, in link frames."""
        robot = RobotModel(
            self.urdf,
            self._model,
            add_boxes(self.sphere_set, boxes),
            self.T_world_base,
            self.left_out,
            are_links_renamed=self.are_links_renamed,
            packages=self._packages,
            locked=self.locked,
        )
        robot._surface = self.surface.add_boxes(boxes)
        return robot

    def replace_coverage(self, coverage: "CoverageReport | None", unknown: str = "") -> "RobotModel":
        """Robot with measured coverage; `unknown` explains missing coverage."""
        deficit = (
            np.full(len(self.sphere_set.radii), np.nan)
            if coverage is None
            else deficit_by_sphere(self.urdf, self.sphere_set, coverage)
        )
        return self._change(coverage=coverage, coverage_unknown=unknown, sphere_deficit=deficit)

    @property
    def surface(self) -> RobotSurface:
        """The visual geometry or its replacements, read on first use."""
        if self._surface is None:
            self._surface = RobotSurface.of(self.urdf, self.sphere_set, self._packages)
        return self._surface

    def join_self_model(self, self_model: SelfModel) -> "RobotModel":
        """Robot with a self-model's permanent parts; `surface_at` adds temporary parts."""
        return self._change(_surface=self.surface.joined(self_model.pieces()), self_model=self_model, _surfaces={})

    @property
    def changes(self) -> list[int]:
        """Stamps [ns], in order, of surface changes."""
        return [] if self.self_model is None else self.self_model.changes()

    def surface_at(self, stamp_ns: int) -> RobotSurface:
        """`surface` plus the temporary parts at a stamp [ns]."""
        if self.self_model is None or not self.changes:
            return self.surface
        number = bisect_right(self.changes, stamp_ns)
        if number not in self._surfaces:
            self._surfaces[number] = self.surface.joined(self.self_model.held_at(stamp_ns))
        return self._surfaces[number]

    def at(self, stamp_ns: int) -> "RobotModel":
        """Robot whose surface is always that of a stamp [ns]."""
        return self._change(_surface=self.surface_at(stamp_ns), self_model=None) if self.changes else self

    def extents(self) -> dict[str, list[float]]:
        """`RobotSurface.extents` of each link in one bent posture."""
        q = np.asarray(0.3 * (1 + np.arange(len(self.joint_names)) % 3), np.float64)  # bent, so that each axis shows
        surface = self.surface
        return surface.extents(surface.poses({link: self.frame_pose(q, link) for link in surface.links}))

    def replace_self_pairs(self, pairs: Index) -> "RobotModel":
        return self._change(_chosen_pairs=np.asarray(pairs, dtype=np.int64).reshape(-1, 2), _allowance=None)

    def replace_self_allowance(self, allowance: Float64) -> "RobotModel":
        return self._change(_allowance=allowance)

    @property
    def self_allowance(self) -> Float64:
        """Reduction (P,) [m] of each pair's margin (`robot.self_margins`)."""
        return np.zeros(len(self.self_pairs())) if self._allowance is None else self._allowance

    def _change(self, **attributes: object) -> "RobotModel":
        other = copy(self)
        other.__dict__.update(attributes)
        return other

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings about these spheres."""
        name, bare, lost = self.urdf.path.name, ", ".join(self.bare_links), ", ".join(self.left_out)
        sentences = (
            (bare, f"{name}: no sphere covers {bare}; the clearance of these links is unknown"),
            (lost, f"spheres of {lost} are left out: {name} has no such link"),
            (self.are_links_renamed, RENAMED),
            (self.locked, self.locked_words),
        )
        return tuple(sentence for is_so, sentence in sentences if is_so)

    @property
    def locked_words(self) -> str:
        values = ", ".join(f"{name} = {value:g}" for name, value in self.locked.items())
        return f"fingers without logged states are locked halfway: {values}; --lock sets other values"

    @property
    def num_joints(self) -> int:
        return len(self.joint_names)

    @property
    def reach_box(self) -> Box:
        reach = self.reach()
        return Box(lower=self.base_position - reach, upper=self.base_position + reach)

    def sphere_centers(self, q: Float64) -> Float64:
        """Centres (S, 3) at q (J,)."""
        return np.asarray(self.chain.centers(self._check(q)[None])[0])

    def sphere_centers_batch(self, q: Float64, *, threads: int = 1) -> Float64:
        """Centres (T, S, 3) at q (T, J)."""
        postures = np.asarray(q, dtype=np.float64)
        refuse_if(
            postures.ndim != 2 or postures.shape[1] != self.num_joints,
            f"joint positions: expected shape (T, {self.num_joints}), got {postures.shape}",
        )
        return self.chain.centers(postures, threads=threads)

    def spheres_at(self, q: Float64) -> tuple[Float64, Float64]:
        """Centres (S, 3) and Jacobians (S, 3, J) at q (J,)."""
        return self.chain.jacobians(self._check(q))

    def frame_pose(self, q: Float64, frame: str) -> Float64:
        """T_world_frame (4, 4) of a link at q (J,). Raises InputError for an unknown link."""
        return np.vstack([self._framed(q, frame)[0], [0.0, 0.0, 0.0, 1.0]])

    def surface_gaps(
        self,
        positions: Float64,
        centers: Floats,
        radii: Floats,
        links: Collection[str] | None = None,
    ) -> dict[str, Float64]:
        """Signed gap (T,) [m] of each meshed link to the nearest ball.

        Balls: centers (N, 3), radii (N,) [m], world. positions (T, J).
        """
        surface = self.surface
        return {
            link: surface.gaps(link, np.array([self.frame_pose(q, link) for q in positions]), centers, radii)
            for link in {surface.links[number]: None for number in surface.trees}
            if links is None or link in links
        }

    @property
    def link_distances(self) -> dict[str, Callable[[Float64, Bool | None], Float64]]:
        """Signed distance functions of meshed links.

        Each maps points (Q, 3), link frame, and a mask (Q,) of points surely outside, or None, to distances (Q,) [m].
        """
        links = {self.surface.links[number] for number in self.surface.trees}
        return {link: partial(self.surface.distance_to, link) for link in sorted(links)}

    def frame_jacobian(self, q: Float64, frame: str) -> Float64:
        """A link origin's Jacobian (6, J), world axes: linear rows [m], then angular."""
        return self._framed(q, frame)[1]

    def _framed(self, q: Float64, frame: str) -> tuple[Float64, Float64]:
        frame_entry = self._model.frames[self._frame(frame)]
        return self.chain.frame(
            self._check(q), frame_entry.parentJoint, np.ascontiguousarray(frame_entry.placement.homogeneous[:3])
        )

    def lever_arms(self) -> Float64:
        """Upper bounds (S, J) [m] on a sphere centre's travel per radian (or metre), in any posture."""
        return lever_arms(self.chain, self.lower, self.upper)

    def reach(self) -> float:
        """Radius [m] about the base that no sphere leaves (sum of link lengths)."""
        length = np.zeros(self.num_joints + 1)
        for body in range(1, self.num_joints + 1):
            step = float(np.linalg.norm(self._model.jointPlacements[body].translation))
            if "JointModelP" in self._model.joints[body].shortname():
                step += max(abs(self.lower[body - 1]), abs(self.upper[body - 1]))
            length[body] = length[self._model.parents[body]] + step
        arms = length[self._sphere_joint] + np.linalg.norm(self._sphere_offset, axis=1)
        return float(np.max(arms + self.sphere_set.radii))

    def self_pairs(self, posture: Float64 | None = None, touching: float = 0.0) -> Index:
        """Pairs (P, 2) of spheres that could collide.

        Excluded: pairs on one or adjacent bodies (fixed joints merge bodies), and pairs within `touching` [m] at
        `posture` (J,) (default: `middle`).
        """
        if self._chosen_pairs is not None and posture is None:
            return self._chosen_pairs
        centers = self.sphere_centers(self.middle if posture is None else posture)
        parents = np.array(self._model.parents, dtype=np.int64)
        a, b = np.triu_indices(len(centers), k=1)
        body_a, body_b = self._sphere_joint[a], self._sphere_joint[b]
        is_near = (body_a == body_b) | (parents[body_a] == body_b) | (parents[body_b] == body_a)
        gap = np.linalg.norm(centers[a] - centers[b], axis=1) - self.sphere_set.radii[a] - self.sphere_set.radii[b]
        keep = ~is_near & (gap > touching)
        return np.stack([a[keep], b[keep]], axis=1).astype(np.int64)

    def joint_columns(self, log_joint_names: Sequence[str]) -> tuple[Index, Float64, Float64]:
        """Each joint's index, factor, offset (J,) in a log: ``position[order] * factor + offset``.

        An unlogged joint follows the logged joint that it mimics. Raises InputError for missing joints.
        """
        log = {name: (column, 1.0, 0.0) for column, name in enumerate(log_joint_names)}
        for joint in self.urdf.joints:
            if joint.mimic is not None and joint.name not in log and joint.mimic[0] in log:
                log[joint.name] = (log[joint.mimic[0]][0], *joint.mimic[1:])
        missing = [name for name in self.joint_names if name not in log]
        if missing:
            hold = f"; hold still what it does not move: --lock {missing[0]}=VALUE"
            raise InputError(
                f"{self.urdf.path}: joints not in the log: {', '.join(missing)}",
                remedy=f"the log has: {', '.join(log_joint_names) or 'no joints'}"
                + (hold if len(missing) < self.num_joints else "; give the URDF of the robot whose joints these are"),
            )
        order, factor, offset = zip(*(log[name] for name in self.joint_names), strict=True)
        return np.array(order, dtype=np.int64), np.array(factor), np.array(offset)

    def positions_of(self, log_joint_names: Sequence[str], position: Float64) -> Float64:
        """A log's positions (..., J) in model order."""
        order, factor, offset = self.joint_columns(log_joint_names)
        return np.asarray(position[..., order] * factor + offset)

    def _check(self, q: Float64) -> Float64:
        if np.shape(q) != (self.num_joints,):
            raise InputError(f"joint positions: expected shape ({self.num_joints},), got {np.shape(q)}")
        return np.asarray(q, dtype=np.float64)

    def _as_chain(self) -> Chain:
        placement = np.array([self.T_world_base, *(p.homogeneous for p in list(self._model.jointPlacements)[1:])])
        data, turns = self._model.createData(), zip(self.middle, self._is_wrapped, strict=True)
        q = np.concatenate([[np.cos(angle), np.sin(angle)] if is_wrapped else [angle] for angle, is_wrapped in turns])
        pinocchio.computeJointJacobians(self._model, data, q)
        local = [
            np.asarray(pinocchio.getJointJacobian(self._model, data, body, pinocchio.ReferenceFrame.LOCAL))
            for body in range(1, self.num_joints + 1)
        ]
        columns = np.array([J.reshape(6, -1)[:, joint] for joint, J in enumerate(local)])
        is_turn = np.linalg.norm(columns[:, 3:], axis=1) > 0.5
        axis = np.where(is_turn[:, None], columns[:, 3:], columns[:, :3])
        return Chain(
            parent=np.array(self._model.parents, dtype=np.int64),
            kind=np.append(REVOLUTE, np.where(is_turn, REVOLUTE, PRISMATIC)).astype(np.int64),
            placement=np.ascontiguousarray(placement[:, :3, :]),
            axis=np.vstack([[0.0, 0.0, 1.0], axis]),
            sphere_body=self._sphere_joint,
            offset=np.ascontiguousarray(self._sphere_offset).reshape(-1, 3),
        )

    def _frame(self, frame: str) -> int:
        what, remedy = f"{self.urdf.path}: no frame '{frame}'", f"frames there: {', '.join(self.urdf.links)}"
        return require(self._frames.get(frame), what, remedy=remedy)


def _without(model: pinocchio.Model, locked: dict[str, float], path: Path) -> pinocchio.Model:
    names = [str(name) for name in model.names]
    for name, joint in zip(names[1:], list(model.joints)[1:], strict=True):
        refuse_if(joint.nv != 1, f"{path}: joint '{name}': expected one degree of freedom, got {joint.nv}")
    missing = [name for name in locked if name not in names]
    refuse_if(
        missing,
        f"{path}: no joint '{''.join(missing[:1])}' to lock",
        remedy=f"movable joints there: {', '.join(names[1:])}",
    )
    refuse_if(len(locked) == len(names) - 1, f"{path}: every joint is locked", remedy="leave at least one joint free")
    if not locked:
        return model
    q = pinocchio.neutral(model)
    for name, value in locked.items():
        joint = model.joints[names.index(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
    return pinocchio.buildReducedModel(model, [names.index(name) for name in locked], q)
