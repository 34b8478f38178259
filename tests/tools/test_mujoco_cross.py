"""The two simulators side by side: the same scene, robot and sensor give the same depth, clearance and statistics."""

import os
from dataclasses import replace

import cv2
import numpy as np
import pytest

os.environ.setdefault("MUJOCO_GL", "egl")
mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install -e '.[sim]'")

from splatctrl_cli.records import Float64, Intrinsics, SphereSet  # noqa: E402
from splatctrl_cli.robot.model import RobotModel  # noqa: E402
from splatctrl_cli.simulate import render, tabletop  # noqa: E402
from splatctrl_cli.simulate.primitives import Primitive  # noqa: E402
from splatctrl_cli.simulate.render import StereoDepth  # noqa: E402
from splatctrl_cli.simulate.truth import distance_to  # noqa: E402
from tests.tools.test_mujoco import LENS, renderer  # noqa: E402, F401
from tools.mujoco.cell import Cell, as_piece  # noqa: E402
from tools.mujoco.depth import DEPTH_LENS, Stereo  # noqa: E402
from tools.mujoco.images import Camera, Studio, views_of  # noqa: E402
from tools.mujoco.poses import look_at, moved, pose  # noqa: E402
from tools.mujoco.robots import Piece, load_robot  # noqa: E402
from tools.mujoco.solids import Solid, fixed  # noqa: E402
from tools.mujoco.truth import Body, clearance_of  # noqa: E402

NONE = np.zeros((480, 640), dtype=bool)


def as_solid(primitive: Primitive) -> Solid:
    """One of our simulator's primitives as a solid of the other's."""
    halves = {"box": [0.5, 0.5, 0.5], "cylinder": [1.0, 0.5], "sphere": [1.0]}
    size = np.array(primitive.size) * halves[primitive.kind]
    kind = primitive.kind.replace("sphere", "ball")
    return Solid(name=primitive.name, kind=kind, size=tuple(size.tolist()), track=fixed(primitive.T_world_shape))


def test_the_same_scene_has_the_same_depth_in_both(renderer: None) -> None:  # noqa: F811
    primitives = [*tabletop.furniture(), *tabletop.objects()]
    T = look_at((1.15, -0.15, 0.95), (0.36, 0.0, 0.10))
    lens = Intrinsics(fx=LENS.fx, fy=LENS.fy, cx=LENS.cx, cy=LENS.cy, width=640, height=480)
    ours = render.Camera(name="camera", intrinsics=lens, T_world_camera=T, is_training=True)
    mine = render.Renderer(ours, primitives, color_rays=0).depth([])
    camera = Camera(name="camera", lens=LENS, T_parent_camera=T)
    cell = Cell(load_robot("panda"), [as_solid(p) for p in primitives], views_of([camera]))
    cell.place(np.array([2.5, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0]), 0.0)
    studio = Studio(cell, [camera], None)
    theirs, is_robot = studio.exact_depth("camera"), studio.is_robot(camera)
    studio.close()
    step = cv2.dilate(mine, np.ones((5, 5), np.uint8)) - cv2.erode(mine, np.ones((5, 5), np.uint8))
    flat = (step < 0.03) & (mine > 0) & ~cv2.dilate(is_robot.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    assert flat.mean() > 0.6
    difference = np.abs(mine - theirs)[flat]
    assert np.quantile(difference, 0.95) < 1e-4
    assert np.quantile(difference, 0.9999) < 1e-3


def test_the_same_spheres_on_the_same_robot_have_the_same_clearance_in_both() -> None:
    robot, rng = load_robot("ur5"), np.random.default_rng(0)
    links = [joint.child for joint in robot.driven for _ in range(3)]
    centers, radii = rng.uniform(-0.1, 0.1, (len(links), 3)), rng.uniform(0.02, 0.06, len(links))
    names = [joint.name for joint in robot.driven]
    model = RobotModel.from_urdf(robot.urdf, SphereSet(links=tuple(links), centers=centers, radii=radii))
    assert [*model.joint_names] == names
    q = rng.uniform(robot.description.low, robot.description.high, (12, 6))
    primitives = tabletop.objects()
    expected = [distance_to(primitives, model.sphere_centers(row), 0) - radii for row in q]
    balls: dict[str, list[Piece]] = {}
    for link, center, radius in zip(links, centers, radii, strict=True):
        piece = as_piece(Solid(name="ball", kind="ball", size=(radius,), track=fixed(np.eye(4))))
        balls.setdefault(link, []).append(replace(piece, vertices=moved(pose(center), piece.vertices)))
    bodies = {link: Body.of(pieces) for link, pieces in balls.items()}
    poses = Cell(robot, (), ()).link_poses(q)
    found = clearance_of(bodies, poses, [as_solid(p) for p in primitives], np.zeros(len(q))).least
    near = np.min(expected, axis=1)
    assert (near < 0.3).sum() > 5
    np.testing.assert_allclose(found, np.minimum(near, 0.3), atol=3e-4)


def test_the_same_stereo_camera_has_the_same_statistics_in_both() -> None:
    ours = StereoDepth(spread=0.06, window=4.0, fattening=(1.0, 3.0), dropout=0.004)
    theirs = Stereo(spread=0.06, window=2.0, fattening=3, dropouts=0.004)
    for distance in (0.5, 1.0, 2.0):
        images = _both(np.full((480, 640), distance), ours, theirs)
        spread = [float(np.std(z[z > 0])) for z in images]
        assert spread[0] == pytest.approx(spread[1], rel=0.08)
        assert [(z == 0).mean() for z in images] == pytest.approx([0.004, 0.004], abs=5e-4)
        assert len({tuple(np.unique(DEPTH_LENS.fx * 0.05 * 32 / z[z > 0]).round(3)[:1]) for z in images}) <= 2
    box = np.full((480, 640), 2.0)
    box[160:320, 200:400] = 1.0
    grown, lost = [], []
    for z in _both(box, replace(ours, dropout=0.0, spread=0.0), replace(theirs, dropouts=0.0, spread=0.0)):
        grown.append(float((np.abs(z[180:300] - 1.0) < 0.05).sum(axis=1).mean() - 200) / 2)
        lost.append(float((z[180:300, 180:200] == 0).sum(axis=1).mean()))
        assert (z[180:300, 403:] > 1.9).all()
    assert grown == pytest.approx([2.0, 2.0], abs=0.35)  # one to three pixels on either side
    assert lost[0] == pytest.approx(lost[1], abs=0.7)


def _both(exact: Float64, ours: StereoDepth, theirs: Stereo) -> tuple[Float64, Float64]:
    """Depth [m] that both stereo models measure, from exact depth [m]."""
    first = ours.applied(exact.astype(np.float32), np.random.default_rng(0), focal=DEPTH_LENS.fx)
    return first.astype(np.float64), theirs.measured(exact, NONE, np.random.default_rng(0))
