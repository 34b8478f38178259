"""A robot cell as a MuJoCo model: links' visual and collision meshes, solids, lights, cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from tools.mujoco.poses import Float64, quat_wxyz
from tools.mujoco.robots import Piece, Robot
from tools.mujoco.solids import Solid

SECTIONS = 96  # around a lathe: the sagitta of 5 cm is 0.03 mm
TEXTURE, TILE = 128, 0.4  # [px] of a texture, [m] of a box's side that one covers
OPTICAL_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])
SEEN, COLLIDES = 1, 3  # geom groups
NEAR, FAR = 0.05, 9.0  # [m] clipping planes


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A pinhole: focal lengths and principal point [px], pixel centres at whole numbers; width, height [px]."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 640
    height: int = 480

    @property
    def matrix(self) -> Float64:
        """K (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


@dataclass(frozen=True, kw_only=True)
class View:
    """One imager: its optical frame (4, 4) in the world, or in the frame of its `link`."""

    name: str
    lens: Lens
    T_parent_view: Float64
    link: str | None = None


class Cell:
    """The model, and one state of it."""

    def __init__(self, robot: Robot, solids: Sequence[Solid], views: Sequence[View], seed: int = 0) -> None:
        self.robot, self.solids, self.views = robot, tuple(solids), tuple(views)
        spec = mujoco.MjSpec()
        spec.stat.extent = 1.0
        spec.visual.map.znear, spec.visual.map.zfar = NEAR, FAR
        spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.25] * 3
        spec.visual.quality.offsamples = 4
        spec.visual.quality.numslices = spec.visual.quality.numstacks = SECTIONS
        for place in ((1.5, -1.0, 3.0), (-0.5, 1.5, 3.0)):
            light = spec.worldbody.add_light(pos=place, diffuse=[0.45] * 3, castshadow=False)
            light.dir = -np.array(place) / np.linalg.norm(place)
        self._add_links(spec)
        rng = np.random.default_rng([seed, 7])
        for solid in self.solids:
            self._add_solid(spec, solid, rng)
        for view in self.views:
            self._add_view(spec, view)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._mocap = {
            solid.name: int(self.model.body(solid.name).mocapid[0]) for solid in self.solids if solid.link is None
        }
        self._qpos = {joint.name: int(self.model.joint(joint.name).qposadr[0]) for joint in robot.moved}
        for joint in robot.moved:
            if joint.kind == "prismatic":
                self.data.qpos[self._qpos[joint.name]] = robot.description.grip
        self.links = (robot.root, *(joint.child for joint in robot.joints))
        self._bodies = [self.model.body(link).id for link in self.links]

    def place(self, q: Float64, time: float) -> None:
        """Move the driven joints to `q` (J,) and every solid to its place at a time [s]."""
        for joint, value in zip(self.robot.driven, q, strict=True):
            self.data.qpos[self._qpos[joint.name]] = value
        for solid in self.solids:
            if solid.link is None:
                T = solid.track.at(np.array([time]))[0]
                index = self._mocap[solid.name]
                self.data.mocap_pos[index], self.data.mocap_quat[index] = T[:3, 3], quat_wxyz(T)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def link_poses(self, q: Float64) -> dict[str, Float64]:
        """T_world_link (T, 4, 4) of every link at joint positions (T, J)."""
        out = np.tile(np.eye(4), (len(self.links), len(q), 1, 1))
        for row, position in enumerate(q):
            for joint, value in zip(self.robot.driven, position, strict=True):
                self.data.qpos[self._qpos[joint.name]] = value
            mujoco.mj_kinematics(self.model, self.data)
            out[:, row, :3, :3] = self.data.xmat[self._bodies].reshape(-1, 3, 3)
            out[:, row, :3, 3] = self.data.xpos[self._bodies]
        return dict(zip(self.links, out, strict=True))

    def view_pose(self, view: View) -> Float64:
        """T_world_view (4, 4) as things stand."""
        if view.link is None:
            return view.T_parent_view
        body = self.model.body(view.link).id
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        return T @ view.T_parent_view

    def geoms_of(self, names: Sequence[str], group: int | None = None) -> NDArray[np.int64]:
        """Numbers of the geoms of these bodies."""
        bodies = [self.model.body(name).id for name in names]
        mine = np.isin(self.model.geom_bodyid, bodies)
        return np.flatnonzero(mine if group is None else mine & (self.model.geom_group == group))

    def _add_links(self, spec: mujoco.MjSpec) -> None:
        root = self.robot.root
        bodies = {root: spec.worldbody if root == "world" else spec.worldbody.add_body(name=root)}
        for joint in self.robot.joints:
            T = joint.T_parent_joint
            body = bodies[joint.parent].add_body(name=joint.child, pos=T[:3, 3], quat=quat_wxyz(T))
            if joint.kind != "fixed":
                kinds = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
                body.add_joint(name=joint.name, type=kinds[joint.kind], axis=joint.axis)
            bodies[joint.child] = body
        for link, body in bodies.items():
            if body is not spec.worldbody:
                body.mass, body.inertia, body.explicitinertial = 1.0, [0.01] * 3, True
            for kind, group in ((self.robot.visual, SEEN), (self.robot.collision, COLLIDES)):
                for number, piece in enumerate(kind.get(link, ())):
                    name = f"{link}.{group}.{number}"
                    _add_mesh(spec, name, piece.vertices, piece.faces)
                    body.add_geom(
                        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=group, rgba=[*piece.rgb, 1.0],
                        contype=0, conaffinity=0,
                    )  # fmt: skip

    def _add_solid(self, spec: mujoco.MjSpec, solid: Solid, rng: np.random.Generator) -> None:
        _add_material(spec, solid, rng)
        if solid.link is None:
            body = spec.worldbody.add_body(name=solid.name, mocap=True)
            place: Mapping[str, object] = {}
        else:
            body, T = spec.body(solid.link), solid.track.poses[0]
            place = {"pos": T[:3, 3], "quat": quat_wxyz(T)}
        kinds = {
            "box": mujoco.mjtGeom.mjGEOM_MESH,
            "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
            "ball": mujoco.mjtGeom.mjGEOM_SPHERE,
            "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
            "lathe": mujoco.mjtGeom.mjGEOM_MESH,
        }
        size = {"size": [*solid.size, *[0.0] * (3 - len(solid.size))]}
        if solid.kind in ("box", "lathe"):
            if solid.kind == "box":
                _add_box(spec, solid)
            else:
                mesh = lathe_mesh(solid.profile)
                _add_mesh(spec, solid.name, mesh.vertices, mesh.faces)
            size = {"meshname": solid.name}  # type: ignore[dict-item]
        body.add_geom(
            name=f"solid.{solid.name}", type=kinds[solid.kind], material=solid.name, group=0, contype=0,
            conaffinity=0, **size, **place,
        )  # fmt: skip

    def _add_view(self, spec: mujoco.MjSpec, view: View) -> None:
        body = spec.worldbody if view.link is None else spec.body(view.link)
        T, lens = view.T_parent_view @ OPTICAL_TO_GL, view.lens
        body.add_camera(
            name=view.name,
            pos=T[:3, 3],
            quat=quat_wxyz(T),
            resolution=[lens.width, lens.height],
            sensor_size=[lens.width * 1e-5, lens.height * 1e-5],
            focal_pixel=[lens.fx, lens.fy],
            principal_pixel=[(lens.width - 1) / 2 - lens.cx, (lens.height - 1) / 2 - lens.cy],
        )


def lathe_mesh(profile: Float64) -> trimesh.Trimesh:
    """The closed mesh of a profile turned about z."""
    mesh = trimesh.creation.revolve(profile, sections=SECTIONS)
    mesh.fix_normals()
    return mesh


def as_piece(solid: Solid) -> Piece:
    """A solid's surface as triangles in its own frame, for solids that move with the robot."""
    make = {
        "box": lambda: trimesh.creation.box(2 * np.array(solid.size)),
        "cylinder": lambda: trimesh.creation.cylinder(solid.size[0], 2 * solid.size[1], sections=SECTIONS),
        "ball": lambda: trimesh.creation.icosphere(subdivisions=4, radius=solid.size[0]),
        "capsule": lambda: _capsule(*solid.size),
        "lathe": lambda: lathe_mesh(solid.profile),
    }
    mesh = make[solid.kind]()
    return Piece(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces, np.int32), rgb=solid.rgb)


def _capsule(radius: float, half: float) -> trimesh.Trimesh:
    angles = np.linspace(-np.pi / 2, np.pi / 2, 41)
    heights = radius * np.sin(angles) + np.where(angles < 0, -half, half)
    return lathe_mesh(np.stack([np.maximum(radius * np.cos(angles), 0.0), heights], axis=1))


def _add_mesh(spec: mujoco.MjSpec, name: str, vertices: Float64, faces: NDArray[np.int32]) -> None:
    spec.add_mesh(
        name=name,
        uservert=np.asarray(vertices, np.float32).ravel(),
        userface=np.asarray(faces, np.int32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def _add_box(spec: mujoco.MjSpec, solid: Solid) -> None:
    """Add a box as a mesh with one texture scale on all six sides, unlike MuJoCo's boxes."""
    corners: list[Float64] = []
    marks: list[list[float]] = []
    faces: list[list[int]] = []
    half = np.array(solid.size)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            first = len(corners)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner = np.zeros(3)
                corner[axis], corner[u], corner[v] = side * half[axis], side * a * half[u], b * half[v]
                corners.append(corner)
                marks.append([corner[u] / TILE, corner[v] / TILE])
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    spec.add_mesh(
        name=solid.name,
        uservert=np.asarray(corners, np.float32).ravel(),
        userface=np.asarray(faces, np.int32).ravel(),
        usertexcoord=np.asarray(marks, np.float32).ravel(),
        userfacetexcoord=np.asarray(faces, np.int32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def _add_material(spec: mujoco.MjSpec, solid: Solid, rng: np.random.Generator) -> None:
    """A speckled texture about the solid's colour: wrapped around it, or tiled over the sides of a box."""
    faces = 1 if solid.kind == "box" else 6
    noise = np.zeros((faces * TEXTURE, TEXTURE))
    for cell, weight in ((32, 0.5), (8, 0.35), (2, 0.15)):
        coarse = rng.uniform(-1, 1, (faces * TEXTURE // cell, TEXTURE // cell))
        noise += weight * np.repeat(np.repeat(coarse, cell, axis=0), cell, axis=1)
    image = np.clip(np.array(solid.rgb) * (1 + 0.7 * noise[..., None]), 0, 1)
    kind = mujoco.mjtTexture.mjTEXTURE_2D if faces == 1 else mujoco.mjtTexture.mjTEXTURE_CUBE
    texture = spec.add_texture(name=solid.name, type=kind, width=TEXTURE, height=faces * TEXTURE, nchannel=3)
    texture.data = np.rint(255 * image).astype(np.uint8).tobytes()
    material = spec.add_material(name=solid.name, specular=0.2, shininess=0.2)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = solid.name
