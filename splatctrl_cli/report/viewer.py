"""What the viewer of a page reads: scenes packed into text, and the three.js that trimesh brings with it.

A scene is ``{"header": {...}, "bytes": "..."}`` in JSON: the bytes are deflated, base64; the header names each array
in them by type, first byte and count. Points are whole numbers of 16 bits within their box: at three metres half a
tenth of a millimetre.
"""

import base64
import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from splatctrl_cli.errors import UsageError
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import Float64, Label
from splatctrl_cli.report.space import Motion, Space, SplatsAt

STEPS = 65535  # of a number of 16 bits
END_OF_LIBRARY = "var camera,controls"  # where three.js ends in trimesh's page and its own script begins
REMEDY = "pip install 'trimesh>=4.4,<6'"


def three_js() -> str:
    """The source of three.js, deflated, base64. Raises UsageError where trimesh no longer brings it."""
    try:
        archive = trimesh.util.decompress(trimesh.resources.get_bytes("templates/viewer.zip"), file_type="zip")
        page = archive["viewer.html.template"].read().decode("utf-8")
        script = page[page.index("<script>") + len("<script>") : page.index(END_OF_LIBRARY)]
    except (OSError, KeyError, ValueError) as error:
        raise UsageError(f"three.js: not found in trimesh: {error}", remedy=REMEDY) from None
    return _deflated(script.encode("utf-8"))


def packed(space: Space) -> str:
    """A scene as the viewer reads it, JSON."""
    block = _Block()
    lower, upper = space.box()
    header: dict[str, Any] = {
        "middle": ((lower + upper) / 2).tolist(),
        "size": max(float(np.linalg.norm(upper - lower)), 0.2),
        "splats": [_splats(block, at, without_robot=space.motion is not None) for at in space.splats],
    }
    if space.unknown is not None and len(space.unknown):
        header["unknown"] = {"points": block.points(space.unknown), "edge": space.voxel}
    if space.surface is not None:
        header["surface"] = _mesh(block, space.surface.vertices, space.surface.faces)
    if space.motion is not None:
        header["motion"] = _motion(block, space.motion)
    if (deciding := space.deciding) is not None:
        header["deciding"] = {
            "sentence": deciding.sentence,
            "time": deciding.time_s,
            "place": np.asarray(deciding.place).tolist(),
        }
        if deciding.sphere is not None:
            center, radius = deciding.sphere
            header["deciding"] |= {"center": np.asarray(center).tolist(), "radius": radius}
    return json.dumps({"header": header, "bytes": _deflated(block.bytes())}, allow_nan=False)


class _Block:
    """Arrays one after the other, each at a multiple of four bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, values: ArrayLike, kind: type[np.generic]) -> list[Any]:
        """[type, first byte, count] of the values, column by column: a column deflates better than a row."""
        array = np.asarray(values, kind)
        data = np.ascontiguousarray(array.T).tobytes()
        start = self._size
        self._parts.append(data + bytes(-len(data) % 4))
        self._size += len(self._parts[-1])
        return [np.dtype(kind).name, start, array.size]

    def points(self, points: NDArray[np.floating]) -> dict[str, Any]:
        """Points (K, 3) within their box, by column."""
        values = np.asarray(points, np.float64).reshape(-1, 3)
        lower, upper = (values.min(axis=0), values.max(axis=0)) if len(values) else (np.zeros(3), np.zeros(3))
        step = np.where(upper > lower, (upper - lower) / STEPS, 1.0)
        whole = np.rint((values - lower) / step)
        return {"array": self.add(whole, np.uint16), "lower": lower.tolist(), "step": step.tolist()}

    def bytes(self) -> bytes:
        return b"".join(self._parts)


def _splats(block: _Block, at: SplatsAt, *, without_robot: bool) -> dict[str, Any]:
    chosen = at.splats.select(at.splats.labels != Label.ROBOT) if without_robot else at.splats
    largest = float(chosen.radii.max(initial=1e-6))
    colors = np.column_stack([np.clip(chosen.colors, 0.0, 1.0), np.clip(chosen.opacities, 0.0, 1.0)])
    return {
        "time": at.time_s,
        "centers": block.points(chosen.centers),
        "radii": block.add(np.rint(chosen.radii / largest * STEPS), np.uint16),
        "largest": largest,
        "colors": block.add(np.rint(255 * colors), np.uint8),
        "labels": block.add(chosen.labels, np.uint8),
    }


def _motion(block: _Block, motion: Motion) -> dict[str, Any]:
    states, links = motion.poses.shape[:2]
    quats = _quats(motion.poses.reshape(-1, 4, 4)).reshape(states, links * 4)
    return {
        "seconds": block.add(motion.seconds, np.float32),
        "clearance": [_or_none(value) for value in motion.clearance.round(6)],
        "margin": motion.margin,
        "links": [_mesh(block, body.vertices, body.faces) for body in motion.bodies.values()],
        "quats": block.add(np.rint(32767 * quats), np.int16),
        "places": block.points(motion.poses[:, :, :3, 3]),
        "path": block.points(motion.path),
    }


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _quats(poses: Float64) -> Float64:
    """(K, 4, 4) -> unit quaternions (K, 4), w last."""
    return np.asarray(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), np.float64)


def _mesh(block: _Block, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> dict[str, Any]:
    return {"vertices": block.points(vertices), "faces": block.add(faces, np.uint32)}


def _deflated(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data)).decode("ascii")


def for_script(text: str) -> str:
    """JSON that may stand in a script element: no end of one, and no comment, is in it."""
    return text.replace("<", "\\u003c")
