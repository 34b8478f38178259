"""Comparison of two URDFs: joints, limits and places of links."""

import numpy as np
import pinocchio

from splatctrl_cli.records import Float64
from splatctrl_cli.robot.urdf import MOVABLE, UrdfFile

POSITION, ROTATION, LIMIT = 1e-4, 1e-3, 1e-4  # [m], [rad], [rad or m and 1/s]: rounding of text
_POSTURES = 3


def model_difference(one: UrdfFile, other: UrdfFile) -> str:
    """The mechanical difference of `other` from `one`, in words; empty if none.

    Compared are names and limits of movable joints, and poses of common links at three postures, but no shapes.
    Raises ValueError for an unbuildable URDF.
    """
    joints = [{joint.name for joint in file.joints if joint.kind in MOVABLE} for file in (one, other)]
    if joints[0] != joints[1]:
        lacks = ((joints[1] - joints[0], one), (joints[0] - joints[1], other))
        return "; ".join(f"{file.path} has no joint {', '.join(sorted(names))}" for names, file in lacks if names)
    models = [pinocchio.buildModelFromXML(file.text) for file in (one, other)]
    for name in sorted(joints[0]):
        limits = [_limits(model, name) for model in models]
        if np.abs(limits[0] - limits[1]).max(initial=0.0) > LIMIT:
            texts = [", ".join(f"{value:g}" for value in values) for values in limits]
            return f"joint {name}: lower, upper and fastest are {texts[0]} in {one.path}, {texts[1]} in {other.path}"
    links = [link for link in one.links if link in other.links]
    if not links:
        return f"{one.path} and {other.path} have no link in common"
    worst, where = 0.0, ""
    for number in range(_POSTURES):
        places = [_places(model, links, number) for model in models]
        for link, a, b in zip(links, *places, strict=True):
            T = np.linalg.inv(a) @ b
            off, turned = float(np.linalg.norm(T[:3, 3])), float(np.linalg.norm(T[:3, :3] - np.eye(3)) / np.sqrt(2))
            if max(off / POSITION, turned / ROTATION) > max(1.0, worst):
                worst = max(off / POSITION, turned / ROTATION)
                by = f"{1e3 * off:.1f} mm and {np.degrees(turned):.1f} degrees"
                where = f"link {link} is {by} elsewhere in {other.path}"
    return where


def _limits(model: pinocchio.Model, name: str) -> Float64:
    joint = model.joints[model.getJointId(name)]
    speed = model.velocityLimit[joint.idx_v : joint.idx_v + 1]
    if joint.nq == 2:
        return np.asarray(speed)
    q = slice(joint.idx_q, joint.idx_q + 1)
    return np.concatenate([model.lowerPositionLimit[q], model.upperPositionLimit[q], speed])


def _places(model: pinocchio.Model, links: list[str], number: int) -> list[Float64]:
    q = pinocchio.neutral(model)
    for place, name in enumerate(sorted(str(name) for name in model.names[1:])):
        joint, angle = model.joints[model.getJointId(name)], 0.3 * number * (1 + place % 3)
        q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, q)
    poses = [data.oMf[model.getFrameId(link, pinocchio.FrameType.BODY)].homogeneous for link in links]
    first = np.linalg.inv(poses[0])
    return [first @ pose for pose in poses]
