"""Recordings made by MuJoCo: their truth, their images, what their sensors measure, and the logs that they write; and
the same scene, robot and sensor in both simulators, which give the same depth, clearance and statistics.
"""

import ast
import hashlib
import json
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

os.environ.setdefault("MUJOCO_GL", "egl")
mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install -e '.[sim]'")

from scipy.spatial.transform import Rotation  # noqa: E402

from splatctrl_cli.cli.main import main  # noqa: E402
from splatctrl_cli.records import Intrinsics, SphereSet  # noqa: E402
from splatctrl_cli.robot.model import RobotModel  # noqa: E402
from splatctrl_cli.simulate import render, tabletop  # noqa: E402
from splatctrl_cli.simulate.primitives import Primitive  # noqa: E402
from splatctrl_cli.simulate.render import StereoDepth  # noqa: E402
from splatctrl_cli.simulate.truth import distance_to  # noqa: E402
from tools.mujoco import recording  # noqa: E402
from tools.mujoco.cell import Cell, Lens, as_piece  # noqa: E402
from tools.mujoco.depth import COUNT, DEPTH_LENS, Laser, Stereo, aligned  # noqa: E402
from tools.mujoco.images import Camera, Studio, views_of  # noqa: E402
from tools.mujoco.poses import Float64, inverse, look_at, moved, pose, turn_rpy  # noqa: E402
from tools.mujoco.recording import ON_SITE, _static_transforms, draw  # noqa: E402
from tools.mujoco.robots import ROBOTS, Piece, load_robot  # noqa: E402
from tools.mujoco.solids import Solid, Track, fixed, frusta, signed_distance  # noqa: E402
from tools.mujoco.stage import bottle, room  # noqa: E402
from tools.mujoco.topics import FORMATS, log_name, opened_log  # noqa: E402
from tools.mujoco.truth import Body, World, clearance_of, load_world, mujoco_difference  # noqa: E402

PACKAGE = Path(recording.__file__).parent
LENS = Lens(fx=610.0, fy=612.0, cx=322.5, cy=236.0)
NONE = np.zeros((480, 640), dtype=bool)
SOLIDS = (
    Solid(name="box", kind="box", size=(0.1, 0.05, 0.2), track=fixed(np.eye(4))),
    Solid(name="cylinder", kind="cylinder", size=(0.08, 0.2), track=fixed(np.eye(4))),
    Solid(name="ball", kind="ball", size=(0.12,), track=fixed(np.eye(4))),
    Solid(name="capsule", kind="capsule", size=(0.06, 0.15), track=fixed(np.eye(4))),
    Solid(name="bottle", kind="lathe", profile=bottle(0.06, 0.25), track=fixed(np.eye(4))),
)


@pytest.fixture(scope="module")
def renderer() -> Iterator[None]:
    """A renderer, or a skip that says so."""
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:
        pytest.skip(f"no renderer: MUJOCO_GL={os.environ['MUJOCO_GL']}: {type(error).__name__}: {error}")
    yield


def points_on(triangles: Float64, num: int, rng: np.random.Generator) -> Float64:
    """Points (num, 3) on triangles (N, 3, 3), by area."""
    edges = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    chosen = rng.choice(len(triangles), num, p=area / area.sum())
    return np.asarray(np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), num), triangles[chosen]))


def test_nothing_of_the_judge_imports_the_tool() -> None:
    for path in PACKAGE.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.split(".")[0] == "splatctrl_cli"], path


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.name)
def test_a_distance_is_that_of_the_nearest_of_many_surface_points(solid: Solid) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.35, 0.35, (25, 3))
    surface = points_on(as_piece(solid).triangles, 200_000, rng)
    nearest = np.array([np.linalg.norm(surface - point, axis=1).min() for point in points])
    distance, slope = signed_distance(solid, points)
    np.testing.assert_allclose(np.abs(distance), nearest, atol=2e-3)
    for axis, shift in enumerate(1e-6 * np.eye(3)):
        change = (signed_distance(solid, points + shift)[0] - signed_distance(solid, points - shift)[0]) / 2e-6
        assert np.median(np.abs(change - slope[:, axis])) < 1e-6


def test_outside_of_a_bottle_its_distance_is_the_least_of_its_frusta() -> None:
    points = np.random.default_rng(1).uniform(-0.3, 0.3, (5000, 3))
    distance = signed_distance(SOLIDS[-1], points)[0]
    parts = np.min([signed_distance(part, points)[0] for part in frusta(SOLIDS[-1])], axis=0)
    np.testing.assert_allclose(parts[distance > 0], distance[distance > 0], atol=1e-12)
    assert (parts[distance < 0] < 0).all()


@pytest.mark.parametrize("name", ROBOTS)
def test_clearance_agrees_with_a_dense_sample_and_with_mujoco(name: str) -> None:
    robot = load_robot(name)
    rng = np.random.default_rng(len(name))
    q = np.array([rng.uniform(robot.description.low, robot.description.high)])
    places = [pose((0.45, 0.2 * k - 0.3, 0.45), turn_rpy(rng.uniform(-1, 1, 3))) for k in range(len(SOLIDS))]
    solids = tuple(replace(s, track=fixed(T)) for s, T in zip(SOLIDS, places, strict=True))
    world = World(robot=robot, solids=solids)
    seen, _ = world.clearances(np.zeros(1), q)
    poses = Cell(robot, (), ()).link_poses(q)
    for column, solid in enumerate(solids):
        points = np.concatenate(
            [moved(poses[link][0], points_on(body.triangles, 12_000, rng)) for link, body in world.seen().items()]
        )
        near = signed_distance(solid, moved(inverse(solid.track.poses[0]), points))[0].min()
        assert -1e-4 <= min(near, 0.3) - seen.per[0, column] < 2.5e-3, (solid.name, near, seen.per[0, column])
    assert mujoco_difference(world, 0.0, q[0]) < 2e-4


def test_what_moves_with_the_robot_is_robot_and_not_an_obstacle() -> None:
    robot = load_robot("panda")
    q = np.array([(np.array(robot.description.low) + robot.description.high) / 2])
    tip = Cell(robot, (), ()).link_poses(q)["panda_hand"][0]
    post = Solid(name="post", kind="ball", size=(0.05,), track=fixed(tip @ pose((0.0, 0.0, 0.40))))
    bare = World(robot=robot, solids=(post,)).clearances(np.zeros(1), q)[0]
    stick = Solid(name="stick", kind="capsule", size=(0.01, 0.08), track=fixed(pose((0, 0, 0.2))), link="panda_hand")
    held = replace(stick, link=None, track=fixed(tip @ pose((0, 0, 0.2))), held=(0.5, 1.0))
    assert World(robot=robot, solids=(post, stick)).clearances(np.zeros(1), q)[0].least[0] == pytest.approx(
        0.06, abs=1e-3
    )
    before, during = (
        World(robot=robot, solids=(post, held)).clearances(np.array([0.0, 0.7]), np.repeat(q, 2, 0))[0].least
    )
    assert before == bare.least[0] > 0.15
    assert during == pytest.approx(0.06, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "model"),
    [("panda_shelf_real", "panda"), ("ur5_near60_ideal", "ur5"), ("panda_near60_ideal", "panda_tight")],
)
def test_the_truth_is_that_of_the_recordings_that_others_made(real_data: Path, name: str, model: str) -> None:
    folder = real_data / "mujoco" / name
    with np.load(folder / "truth.npz") as known:
        solids = [
            _theirs(entry, known["t_pose"], known[f"pose_{entry['name']}"])
            for entry in json.loads((folder / "truth.json").read_text(encoding="utf-8"))["objects"]
            if entry["kind"] != "mesh"
        ]
        t, q, visual = (known[column][::20] for column in ("t", "q", "visual"))
    ours = World(robot=load_robot(model), solids=tuple(solids)).clearances(t, q)[0].least
    assert np.abs(ours - np.minimum(visual, 0.3)).max() < 5e-4


def test_exact_depth_lies_on_the_true_surfaces(renderer: None) -> None:
    robot = load_robot("panda")
    solids = [*room(), *(replace(s, track=fixed(pose((0.5, 0.25 * k - 0.5, 0.3)))) for k, s in enumerate(SOLIDS))]
    camera = Camera(name="camera", lens=LENS, T_parent_camera=look_at((1.2, 0.9, 0.9), (0.4, 0.0, 0.3)))
    cell = Cell(robot, solids, views_of([camera]))
    q = (np.array(robot.description.low) + robot.description.high) / 2
    cell.place(q, 0.0)
    studio = Studio(cell, [camera], None)
    image = studio.image(camera, [0])
    is_robot = studio.is_robot(camera)
    studio.close()

    def seen(which: np.ndarray) -> Float64:
        """Points [m] of pixels with depth."""
        v, u = np.nonzero((image.depth > 0) & which)
        z = image.depth[v, u] * COUNT
        rays = np.stack([(u - LENS.cx) / LENS.fx * z, (v - LENS.cy) / LENS.fy * z, z], axis=1)
        return moved(camera.T_parent_camera, rays)

    points = seen(~is_robot)
    away = np.min([np.abs(signed_distance(s, moved(inverse(s.track.poses[0]), points))[0]) for s in solids], axis=0)
    assert len(points) > 200_000
    assert np.quantile(away, 0.95) < 5e-4
    points = seen(is_robot)
    pieces = {link: Body.of(found) for link, found in robot.visual.items() if found}
    poses = cell.link_poses(q[None])
    for point in points[:: len(points) // 60]:
        ball = Solid(name="point", kind="ball", size=(0.0,), track=fixed(pose(point)))
        assert clearance_of(pieces, poses, [ball], np.zeros(1)).least[0] < 6e-4


def test_stereo_errs_as_its_figures_say() -> None:
    sensor, rng = Stereo(spread=0.07, fattening=2, dropouts=0.0), np.random.default_rng(0)
    for distance, expected in ((0.5, 0.9e-3), (1.0, 3.63e-3), (2.0, 14.5e-3)):
        z = sensor.measured(np.full((480, 640), distance), NONE, rng)
        assert np.std(z) == pytest.approx(expected, rel=0.12)  # z^2 spread / (f b)
        disparity = DEPTH_LENS.fx * sensor.baseline / z
        np.testing.assert_allclose(disparity * 32, np.rint(disparity * 32), atol=1e-6)
    error = z - z.mean()
    assert np.mean(error[:, 1:] * error[:, :-1]) / np.var(error) == pytest.approx(np.exp(-1 / 16), abs=0.03)
    assert abs(np.mean(error[:, 16:] * error[:, :-16]) / np.var(error)) < 0.05


def test_stereo_fattens_a_foreground_and_loses_what_the_right_imager_does_not_see() -> None:
    exact = np.full((480, 640), 2.0)
    exact[160:320, 200:400] = 1.0
    z = Stereo(spread=0.0, fattening=3, dropouts=0.0).measured(exact, NONE, np.random.default_rng(0))
    is_near = np.abs(z - 1.0) < 0.03
    widths = is_near[200:280].sum(axis=1)
    assert widths.min() >= 202 and widths.max() <= 206 and len(set(widths)) > 1
    left, right = z[240, 180:197], z[240, 404:420]
    shadow = DEPTH_LENS.fx * 0.05 * (1 / 1.0 - 1 / 2.0)  # 9.7 px
    assert np.count_nonzero(z[240, 180:200] == 0) == pytest.approx(shadow - 2, abs=2)
    assert (right > 1.9).all() and (left == 0).any()


def test_a_laser_mixes_depths_at_an_edge() -> None:
    exact = np.full((480, 640), 2.0)
    exact[:, 320:] = 1.0
    z = Laser(dropouts=0.0).measured(exact, NONE, np.random.default_rng(0))
    assert np.std(z[:, 400:]) == pytest.approx(2.5e-3, rel=0.03)
    between = (z > 1.05) & (z < 1.95)
    assert not between[:, :318].any() and not between[:, 322:].any()
    assert 0.3 < between[:, 319:321].mean() < 0.6


def test_aligned_depth_of_a_plane_is_the_plane() -> None:
    assert set(np.unique(aligned(np.full((480, 640), 1.2), LENS))) == {1200}
    square = np.zeros((480, 640))
    square[230:250, 310:330] = 1.0
    v, u = np.nonzero(aligned(square, LENS))
    middle = (np.array([319.5, 239.5]) - [DEPTH_LENS.cx, DEPTH_LENS.cy]) / DEPTH_LENS.fx + [0.015, 0.0]
    assert u.mean() == pytest.approx(middle[0] * LENS.fx + LENS.cx, abs=0.6)
    assert v.mean() == pytest.approx(middle[1] * LENS.fy + LENS.cy, abs=0.6)
    assert len(u) == pytest.approx(400 * (611 / 386) ** 2, rel=0.1)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_log_of_each_format_is_read_by_the_tool(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = Camera(name="camera_left", lens=LENS, T_parent_camera=np.eye(4))
    with opened_log(tmp_path, kind) as log:
        log.add_transforms(0.0, [("world", "camera_left_link", np.eye(4))], is_static=True)
        for k in range(3):
            log.add_joints(k / 10, ["a", "b"], np.array([0.1, 0.2]), np.zeros(2))
            color = np.full((480, 640, 3), 90, np.uint8)
            log.add_image(k / 10, camera, color, np.full((480, 640), 1234, np.uint16))
    assert main(["info", str(tmp_path / log_name(kind)), "--json"]) == 0
    said = capsys.readouterr().out
    recipe = (
        (Path(__file__).parents[2] / "docs" / "input.md")
        .read_text()
        .split("ros2 bag record", 1)[1]
        .split("splatctrl", 1)[0]
    )
    topics = set(re.findall(r"/camera/left/\S+", recipe))
    assert len(topics) == 3 and all(topic.replace("/left/", "/camera_left/") in said for topic in topics)
    assert "joint_states" in said


def test_a_recording_is_whole_and_the_same_twice(
    renderer: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(recording, "RATE", 0.5)
    monkeypatch.setattr(recording, "JOINT_RATE", 20.0)
    monkeypatch.setattr(recording, "TF_RATE", 10.0)
    digests = []
    for name in ("one", "other"):
        recording.record(3, 7, tmp_path / name)  # where a solid arrives
        digests.append([hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted((tmp_path / name).rglob("*.*"))])
    assert digests[0] == digests[1]
    folder = tmp_path / "one"
    said = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    with np.load(folder / "truth.npz") as truth:
        assert len(truth["t"]) == 81 and truth["visual"].min() == said["min_visual"]
        again = load_world(folder).clearances(truth["t"], truth["q"])[0].least
        np.testing.assert_allclose(again, truth["visual"], atol=1e-12)
    assert said["mujoco_difference"] < 2e-4
    assert main(["info", str(folder / said["log"]), "--json"]) == 0
    shown = capsys.readouterr().out
    assert all(camera in shown for camera in said["cams"])


def test_from_a_seed_on_the_world_stands_somewhere_in_the_root_frame_of_the_log() -> None:
    edges = {seed: _static_transforms(draw(seed, 0)) for seed in (ON_SITE - 1, ON_SITE)}
    assert [{parent for parent, _, _ in its} >= {"site"} for its in edges.values()] == [False, True]
    (T,) = [T for parent, child, T in edges[ON_SITE] if (parent, child) == ("site", "world")]
    assert np.linalg.norm(T[:3, 3]) > 0.1 and T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def _theirs(entry: dict[str, object], times: Float64, rows: Float64) -> Solid:
    """A solid of the recordings that others made."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = rows[:, :3], Rotation.from_quat(rows[:, 3:]).as_matrix()
    kind = str(entry["kind"]).replace("sphere", "ball")
    size = tuple(float(value) for value in np.asarray(entry["size"]))
    return Solid(name=str(entry["name"]), kind=kind, size=size, track=Track(times=times, poses=poses))


def as_solid(primitive: Primitive) -> Solid:
    """One of our simulator's primitives as a solid of the other's."""
    halves = {"box": [0.5, 0.5, 0.5], "cylinder": [1.0, 0.5], "sphere": [1.0]}
    size = np.array(primitive.size) * halves[primitive.kind]
    kind = primitive.kind.replace("sphere", "ball")
    return Solid(name=primitive.name, kind=kind, size=tuple(size.tolist()), track=fixed(primitive.T_world_shape))


def test_the_same_scene_has_the_same_depth_in_both(renderer: None) -> None:
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
