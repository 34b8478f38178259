"""Occupied voxels without a splat are obstacles wherever a distance is asked for; people are kept farther off."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import Config, ControlConfig
from splatctrl_cli.control.columns import UNREPRESENTED
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.jobs.replay.known_scene import read_splat_scene, splat_fields
from splatctrl_cli.records import Float64, Label
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import Balls, OccupancyGrid
from tests.cli.replay_desk import SECOND, START, clearance, splats_of, write_scene
from tests.jobs.stage import FAR, Ball, Beside, Stage, resting
from tests.recording.log.make_log import messages_of, write_raw
from tests.reference.unrepresented import unrepresented

RADIUS = 0.05 * 3**0.5  # of a ball: the grid's voxels have 10 cm
PLACE = (0.5, 0.0, 0.4)
POINTS = np.array([[0.5, 0.0, 0.7], [0.0, 0.0, 0.2]])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    splats = splats_of(((0.0, 0.0, 0.0), 0.05))
    folder = tmp_path_factory.mktemp("scenes") / "scene"
    return write_scene(folder, (0, splats), (SECOND, splats), unrepresented=[PLACE])


@pytest.mark.parametrize("stamp_ns", [0, SECOND])
def test_both_fields_of_a_replay_know_them_at_every_time(scene: Path, stamp_ns: int) -> None:
    fields = read_splat_scene(scene, Config(), 1).at(stamp_ns)
    assert fields.distances["exact"](POINTS) == pytest.approx([0.3 - RADIUS, 0.15], abs=1e-6)
    barrier = fields.barrier.query(POINTS)[0][0]
    assert barrier == pytest.approx(0.3 - RADIUS, abs=1e-3) and barrier <= 0.3 - RADIUS + 1e-6
    voxel, splat = fields.obstacles(POINTS)
    assert (splat.label, splat.splat) == ("object", 0)
    assert (voxel.label, voxel.splat, voxel.cell) == (UNREPRESENTED, None, None)
    assert voxel.position == pytest.approx((0.5, 0.0, 0.4 + RADIUS))
    assert str(voxel).startswith("unrepresented voxel at (0.500")


def test_a_persons_voxels_count_as_people() -> None:
    balls = Balls.from_voxels(np.float32([PLACE]), 0.1, np.array([Label.HUMAN], np.uint8))
    config = Config(control=ControlConfig(margin=0.02, human_margin=0.12))
    fields = splat_fields(splats_of(((0.0, 0.0, 0.0), 0.05)), config, 1, balls)
    assert fields.human.query(POINTS)[0][0] == pytest.approx(0.3 - RADIUS, abs=1e-6)
    assert fields.barrier.query(POINTS)[0][0] == pytest.approx(0.3 - RADIUS - 0.1, abs=1e-3)
    assert fields.balls is None  # the spheres keep the margin of people
    plain = splat_fields(splats_of(((0.0, 0.0, 0.0), 0.05)), Config(), 1, balls)
    assert plain.balls is plain.distances["exact"]


@pytest.mark.parametrize("at", [None, "0"])
def test_a_baked_field_holds_them_and_says_how_many(scene: Path, tmp_path: Path, at: str | None) -> None:
    box = ["--box=0.3,-0.1,0.3,0.7,0.1,0.9", "--voxel", "0.1", "--set", "field.max_loss=1"]
    when = ["--channels", "sdf,hard,bound", *([] if at is None else ["--at", at])]
    assert main(["sdf-bake", str(scene), "-o", str(tmp_path / "field"), *box, *when, "-q"]) == 0
    grid = read_npz(tmp_path / "field" / "field.npz")
    values = [grid.channels[channel][2, 1, 4] for channel in ("hard", "sdf")]
    assert values == pytest.approx([0.3 - RADIUS] * 2, abs=1e-3)
    used = {"object": 1, "robot": 0, "human": 0}
    assert (grid.header["unrepresented_voxels"], grid.header["splats_used"]) == (1, used)
    assert json.loads((tmp_path / "field" / "field.json").read_text())["splats_used"]["object"] == 1


@pytest.mark.usefixtures("unchecked")
def test_a_starved_budget_hides_nothing_that_arrives(sample_data: Path, tmp_path: Path) -> None:
    # The sample's cylinder is there from 2.3 to 4.7 s; 3,000 splats are fewer than the room takes.
    sample, log = sample_data / "tabletop", tmp_path / "log.mcap"
    messages = [m for m in messages_of(sample / "log.mcap") if m.log_time_ns is not None]
    write_raw(log, [m for m in messages if m.log_time_ns < messages[0].log_time_ns + 5 * SECOND])
    robot = ["--urdf", sample / "robot.urdf", "--spheres", sample / "robot_spheres.yaml"]
    short = ["--set", "scene.first_iterations=20", "--set", "scene.iterations_per_step=1"]
    arguments = ["reconstruct", log, "--cameras", "cam0,cam1", "--max-splats", "3000"]
    assert main([str(a) for a in (*arguments, *robot, *short, "-o", tmp_path / "scene", "-q")]) == 0
    scene = open_scene(tmp_path / "scene")
    primitives = json.loads((sample / "truth.json").read_text())["primitives"]
    (visitor,) = (p for p in primitives if p["name"] == "visitor")
    num_looked_at = 0
    for snapshot in (s for s in scene.snapshots if visitor["from_ns"] < s.stamp_ns < visitor["to_ns"]):
        grid, bare, splats = snapshot.occupancy(), snapshot.unrepresented(), snapshot.splats()
        there = occupied_in(visitor, grid)
        num_looked_at += len(there) > 50
        others = splats.select(splats.labels != Label.ROBOT)
        is_bare = unrepresented(there, others.centers.astype(float), others.radii.astype(float), 0.028)
        balls = bare.centers.astype(float)
        is_bare &= unrepresented(there, balls, np.zeros(len(balls)), 0.01)
        assert is_bare.sum() <= 0.1 * len(there)  # those hit once, which is not enough
    assert num_looked_at >= 9
    metrics = scene.run["metrics"]
    assert metrics["max_unrepresented_voxels"] > metrics["unrepresented_voxels"]
    assert metrics["unrepresented_volume"] == pytest.approx(metrics["unrepresented_voxels"] * 0.02**3)
    assert metrics["evicted"] > 0


def occupied_in(visitor: dict[str, Any], grid: OccupancyGrid) -> Float64:
    """Centres (K, 3) [m] of the occupied voxels on an upright cylinder, 3 cm above the table or more."""
    centers = grid.origin + grid.voxel * np.argwhere(grid.log_odds > 0)
    x, y, _ = np.array(visitor["T_world_shape"])[:3, 3]
    radius, height = visitor["size"]
    across = np.hypot(centers[:, 0] - x, centers[:, 1] - y)
    return np.asarray(centers[(across < radius + 0.02) & (centers[:, 2] > 0.03) & (centers[:, 2] < height)])


def test_a_scene_of_an_older_version_has_none(tmp_path: Path, scene: Path) -> None:
    old = write_scene(tmp_path / "old", (0, splats_of(((0.0, 0.0, 0.0), 0.05))))
    (old / "snapshots" / "000000.npz").unlink()
    assert read_splat_scene(old, Config(), 1).at(0).distances["exact"](POINTS)[0] > 0.6


@pytest.mark.parametrize(
    ("kind", "human_margin", "broken"),
    [
        ("people", 0.055, {}),
        ("people", 0.065, {"clearance of people": "failed"}),
        ("balls", 0.1, {}),
    ],
)
def test_people_and_no_things_are_kept_at_a_margin_of_their_own(
    stage: Stage, kind: str, human_margin: float, broken: dict[str, str]
) -> None:
    setattr(stage, kind, [FAR, Beside(0.06)])
    stage.expect(int(bool(broken)), broken, "--set", f"control.human_margin={human_margin}")


def test_the_truth_is_that_of_the_nearest_surface_not_of_the_nearest_centre(stage: Stage, arm: RobotModel) -> None:
    stage.states = resting(num=3)
    ball = deceiving(arm, START)
    stage.judged("--truth", str(stage.truth(ball)))
    assert stage.desk.metrics()["min_clearance_true"] == pytest.approx(clearance(arm, START, ball), abs=1e-9)


def deceiving(arm: RobotModel, q: Float64) -> Ball:
    """A ball whose nearest sphere by the centre is not the one whose surface is nearest."""
    moving = np.flatnonzero(arm.moving_spheres)
    centers, radii = arm.sphere_centers(q)[moving], arm.sphere_set.radii[moving]
    for point in np.random.default_rng(0).uniform(-1, 1, (5000, 3)):
        gaps = np.linalg.norm(centers - point, axis=1)
        if (gaps - radii)[np.argmin(gaps)] > (gaps - radii).min() + 0.005 and (gaps - radii).min() > 0.15:
            return (float(point[0]), float(point[1]), float(point[2])), 0.05
    raise AssertionError
