"""The truth of a simulated log: solids over time, and exact distance."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import refuse_faults, refuse_if
from splatctrl_cli.formats.unpacking import read_text
from splatctrl_cli.records import Float64, Intrinsics, Stamps
from splatctrl_cli.simulate.primitives import ALWAYS, Primitive, Texture, Track, closest_point
from splatctrl_cli.simulate.render import Camera

FORMAT = "splatctrl-truth"
VERSIONS = (1, 2)  # 2 adds capsules and moving solids; a file has the lowest version that suffices
NUM_SIZES = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2}


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Obstacles over time, cameras and robot of a simulated log; world, m, ns.

    clearance (T,) [m]: of moving collision spheres and `unmodelled` parts, at stamps (T,) int64 [ns] of joint states.
    luminance_std: by camera, the least of its images (0 to 1).
    """

    path: Path
    primitives: tuple[Primitive, ...]
    cameras: tuple[Camera, ...]
    luminance_std: Mapping[str, float]
    joint_names: tuple[str, ...]
    robot_urdf: Path
    robot_spheres: Path
    T_world_base: Float64
    stamps: Stamps
    clearance: Float64
    unmodelled: tuple[str, ...] = ()

    def distance(self, points_world: Float64, stamp_ns: int) -> Float64:
        """Signed distance (Q,) [m] of points (Q, 3) to solids at a stamp, without the robot."""
        return distance_to(self.primitives, points_world, stamp_ns)

    def closest(self, points_world: Float64, stamp_ns: int) -> tuple[Float64, Float64]:
        """Signed distance (Q,) [m], and its surface point (Q, 3)."""
        return closest_of(self.primitives, points_world, stamp_ns)


def distance_to(primitives: Sequence[Primitive], points_world: Float64, stamp_ns: int) -> Float64:
    """Signed distance (Q,) [m] of points (Q, 3) to the present solids; exact outside."""
    return closest_of(primitives, points_world, stamp_ns)[0]


def distance_along(primitives: Sequence[Primitive], points_world: Float64, stamps: Stamps) -> Float64:
    """Signed distance (T, Q) [m] of points (T, Q, 3) to solids present at stamps (T,)."""
    distance = np.full(points_world.shape[:2], np.inf)
    for primitive in primitives:
        present = np.flatnonzero([primitive.is_present(int(stamp)) for stamp in stamps])
        for at in present[None] if primitive.track is None else present[:, None]:
            if len(at):
                near, _ = closest_point(primitive.at(int(stamps[at[0]])), points_world[at].reshape(-1, 3))
                distance[at] = np.minimum(distance[at], near.reshape(len(at), -1))
    return distance


def closest_of(primitives: Sequence[Primitive], points_world: Float64, stamp_ns: int) -> tuple[Float64, Float64]:
    """Signed distance (Q,) [m] and surface point (Q, 3) of the nearest present solid."""
    points = np.asarray(points_world, dtype=np.float64)
    distance = np.full(len(points), np.inf)
    surface = np.full((len(points), 3), np.nan)
    for primitive in primitives:
        if primitive.is_present(stamp_ns):
            near, where = closest_point(primitive.at(stamp_ns), points)
            is_nearer = near < distance
            distance[is_nearer] = near[is_nearer]
            surface[is_nearer] = where[is_nearer]
    return distance, surface


def truth_document(truth: Truth) -> dict[str, Any]:
    """The truth as JSON values; `load_truth` restores it."""
    return {
        "format": FORMAT,
        "version": VERSIONS[any(p.kind == "capsule" or p.track is not None for p in truth.primitives)],
        "frame": "world",
        "units": {"length": "m", "time": "ns", "angle": "rad"},
        "primitives": [_primitive_document(primitive) for primitive in truth.primitives],
        "cameras": [
            {
                "name": camera.name,
                "role": "training" if camera.is_training else "scoring",
                "intrinsics": asdict(camera.intrinsics),
                "T_world_camera": camera.T_world_camera.tolist(),
                "luminance_std": round(truth.luminance_std[camera.name], 6),
            }
            for camera in truth.cameras
        ],
        "robot": {
            "urdf": truth.robot_urdf.name,
            "spheres": truth.robot_spheres.name,
            "joint_names": list(truth.joint_names),
            "T_world_base": truth.T_world_base.tolist(),
            **({"unmodelled": list(truth.unmodelled)} if truth.unmodelled else {}),
        },
        "clearance": {
            "of": f"{', '.join(('moving collision spheres', *truth.unmodelled))} to everything present but the robot",
            "min": round(float(np.min(truth.clearance)), 6),
            "stamps": truth.stamps.tolist(),
            "distance": [round(value, 6) for value in truth.clearance.tolist()],
        },
    }


def load_truth(path: Path) -> Truth:
    """Read a truth file. Raises InputError for a missing, foreign or damaged file."""
    with refuse_faults(f"{path}: not valid JSON", ValueError):
        document = json.loads(read_text(path, "give a truth.json"))
    is_ours = isinstance(document, dict) and document.get("format") == FORMAT
    refuse_if(
        not is_ours or document.get("version") not in VERSIONS,
        f"{path}: expected {FORMAT} version {' or '.join(map(str, VERSIONS))}",
        remedy="give the truth.json that simulate wrote",
    )
    with refuse_faults(
        lambda error: f"{path}: damaged: {type(error).__name__}: {error}",
        *(KeyError, TypeError, ValueError),
        remedy="write it anew with simulate",
    ):
        robot, clearance = document["robot"], document["clearance"]
        cameras = tuple(
            Camera(
                name=entry["name"],
                intrinsics=Intrinsics(**entry["intrinsics"]),
                T_world_camera=_pose(entry["T_world_camera"]),
                is_training=entry["role"] == "training",
            )
            for entry in document["cameras"]
        )
        return Truth(
            path=path,
            primitives=tuple(_primitive(entry) for entry in document["primitives"]),
            cameras=cameras,
            luminance_std={entry["name"]: float(entry["luminance_std"]) for entry in document["cameras"]},
            joint_names=tuple(robot["joint_names"]),
            robot_urdf=path.parent / robot["urdf"],
            robot_spheres=path.parent / robot["spheres"],
            T_world_base=_pose(robot["T_world_base"]),
            stamps=np.array(clearance["stamps"], dtype=np.int64),
            clearance=np.array(clearance["distance"], dtype=np.float64),
            unmodelled=tuple(robot.get("unmodelled", ())),
        )


def _primitive_document(primitive: Primitive) -> dict[str, Any]:
    track = primitive.track
    return {
        "name": primitive.name,
        "kind": primitive.kind,
        "size": list(primitive.size),
        "T_world_shape": primitive.T_world_shape.tolist(),
        "from_ns": None if primitive.from_ns == ALWAYS[0] else primitive.from_ns,
        "to_ns": None if primitive.to_ns == ALWAYS[1] else primitive.to_ns,
        "texture": asdict(primitive.texture),
        **({} if track is None else {"track": {name: value.tolist() for name, value in vars(track).items()}}),
    }


def _primitive(entry: dict[str, Any]) -> Primitive:
    refuse_if(
        len(entry["size"]) != NUM_SIZES[entry["kind"]] or min(entry["size"]) <= 0,
        f"size of {entry['name']}: {entry['size']}",
        error=ValueError,
    )
    texture, track = entry["texture"], entry.get("track")
    return Primitive(
        name=entry["name"],
        kind=entry["kind"],
        size=tuple(entry["size"]),
        T_world_shape=_pose(entry["T_world_shape"]),
        texture=Texture(**{**texture, "dark": tuple(texture["dark"]), "bright": tuple(texture["bright"])}),
        from_ns=ALWAYS[0] if entry["from_ns"] is None else entry["from_ns"],
        to_ns=ALWAYS[1] if entry["to_ns"] is None else entry["to_ns"],
        track=None
        if track is None
        else Track(
            stamp_ns=np.array(track["stamp_ns"], dtype=np.int64),
            T_world_shape=np.array([_pose(rows) for rows in track["T_world_shape"]]),
        ),
    )


def _pose(rows: object) -> Float64:
    T = np.array(rows, dtype=np.float64)
    refuse_if(
        T.shape != (4, 4) or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6),
        f"not a rigid transform: {rows}",
        error=ValueError,
    )
    return T
