"""A box that the hand carries; maps that are kept; and recordings in another unit of length."""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatctrl_cli.config import Config, SceneConfig, load_config
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.geometry import strided_lens
from splatctrl_cli.jobs.check import CheckRequest, check
from splatctrl_cli.jobs.reconstruct.kept_maps import KeptMaps
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import Label, Record, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions
from tests.calibration.scan import views_of
from tests.cli.replay_desk import START, Desk, FakeSource
from tests.field.scenes import splat_set
from tests.jobs.bake.baked import Said
from tests.jobs.stage import MOVE, Stage, states_on
from tests.plain import known, plain_grid
from tests.recording.folder.make_layout import OPENGL_FROM_OPTICAL
from tests.refused import expect_refusal
from tests.robot import shapes

CUBE = '<origin xyz="0 0 0.15"/><geometry><box size="0.07 0.07 0.07"/></geometry>'
HELD = f"<visual>{CUBE}</visual><collision>{CUBE}</collision>"
BOX = "[-0.045, -0.045, 0.105, 0.045, 0.045, 0.195]"
FRAMES = 6
RAISED = START + np.array([0.0, -0.4, 0.0, 0.0, 0.0, 0.0, 0.0])


@dataclass(kw_only=True)
class Carrying(FakeSource):
    """The tabletop's arm with a cube in its hand, seen by three cameras five times a second."""

    in_order: Sequence[Record] = ()

    def records(self) -> Iterator[Record]:
        yield from self.in_order


@pytest.fixture(scope="module")
def recorded(plain_arm: Path, tmp_path_factory: pytest.TempPathFactory) -> Carrying:
    tabletop = plain_arm / "tabletop"
    before, link, after = (tabletop / "robot.urdf").read_text().partition('<link name="hand">')
    urdf = shapes.written(tmp_path_factory.mktemp("carrying"), f"{before}{link}{HELD}{after}")
    options = RecordingOptions(duration_s=1.2, width=128, height=96, noise="none", color_rays=0)
    recording = Recording(options, RobotModel.from_urdf(urdf, tabletop / "robot_spheres.yaml"))
    states = states_on(RAISED + np.linspace(0, 1, 11)[:, None] * MOVE, start_ns=START_NS)
    frames = [f for i in range(FRAMES) for f in recording.frames_at(i, states[2 * i].position)]
    records = sorted([*states, *frames], key=lambda r: r.stamp_ns)
    return Carrying(states=states, in_order=records, cameras=("cam0", "cam1", "cam2"))


@pytest.fixture
def stage(desk: Desk, arm: RobotModel, recorded: Carrying) -> Stage:
    desk.source = recorded
    return Stage(desk=desk, arm=arm, states=recorded.states)


def declared(folder: Path, *boxes: str) -> Path:
    entries = (f'[[carried]]\nlink = "hand"\nbox = {box}\nstart = 0\nend = 9\n' for box in boxes)
    return shapes.written(folder, "".join(entries), "declared.toml")


def mapped(stage: Stage, declare: Path | None, progress: Progress = SILENT) -> JudgedResult:
    request = ReconstructRequest(
        source=stage.desk.source,
        out=stage.desk.folder / "scene",
        config=load_config(
            None, ["scene.max_splats=3000", "scene.first_iterations=10", "scene.iterations_per_step=3"]
        ),
        urdf=Path(stage.desk.robot[1]),
        spheres=Path(stage.desk.robot[3]),
        declare=declare,
        threads=1,
    )
    return reconstruct(request, progress)


def test_a_box_that_is_declared_is_no_obstacle_and_listed_by_every_verdict(stage: Stage, tmp_path: Path) -> None:
    """The declared box is a centimetre larger than the cube on every side; a second one holds nothing."""
    declare = declared(tmp_path, BOX, "[0.5, 0.5, 0.5, 0.6, 0.6, 0.6]")
    found, scene = mapped(stage, declare, heard := Said()), stage.desk.folder / "scene"
    verdict = stage.expect(0, {}, "--declare", str(declare), scene=scene, label="safe")
    words = "hand carries a box from 0 to 9 s: "
    for notes in (found.verdict.notes, verdict["notes"]):
        used, unused = (note for note in notes if "carries a box" in note)
        assert re.fullmatch(words + r"[1-9]\d+ points", used)
        assert unused == words + "warning: no pixel of any frame needed it; check link and box"
    assert [line for line in heard.lines if "[[carried]] 2: no pixel" in line]
    assert not [note for note in verdict["notes"] if "inside the robot" in note]
    _, verdict = stage.judged(scene=scene)
    assert any("hand carries a box" in note for note in verdict["notes"]), "the map was made with it"


def test_a_box_that_is_not_declared_is_contact(stage: Stage, tmp_path: Path) -> None:
    mapped(stage, None)
    scene = stage.desk.folder / "scene"
    code, verdict = stage.judged(scene=scene)
    assert (code, verdict["label"]) == (1, "contact")
    code, verdict = stage.judged("--declare", str(declared(tmp_path, BOX)), scene=scene)
    said = "the map was made without this declaration; give reconstruct the same --declare"
    assert code == 1 and f"hand carries a box: warning: {said}" in verdict["notes"]


def test_links_that_spheres_stand_for_are_named(stage: Stage, tmp_path: Path) -> None:
    before, link, after = Path(stage.desk.robot[1]).read_text().partition('<link name="hand">')
    other = shapes.written(tmp_path, before + link + after.replace("<box ", "<cone "), "other.urdf")
    mapped(stage, None, heard := Said())
    assert not [line for line in heard.lines if "spheres stand for" in line]
    stage.desk.robot[1], stage.desk.folder = str(other), tmp_path / "again"
    mapped(stage, None, heard)
    assert f"warning: spheres stand for hand: {other}: <cone> cannot be read; correct the URDF" in heard.lines


VOXEL = 0.02  # of 50 x 50 x 50 around the origin, free where x > -0.2, never seen elsewhere
THING = np.array([[0.1, 0.1, 0.1], [0.12, 0.1, 0.1], [0.1, 0.12, 0.1]])
FLOOR = np.array([[x, y, -0.3] for x in np.arange(-0.4, 0.4, 0.02) for y in np.arange(-0.4, 0.4, 0.02)])


def kept(folder: Path, splats: ArrayLike) -> KeptMaps:
    """After one map with these splats."""
    folder.mkdir()
    writer = SceneWriter(folder, {"frame": "world"})
    x = -0.5 + VOXEL * np.arange(50)[:, None, None]
    grid = plain_grid(
        (50, 50, 50), VOXEL, -0.5, num_updates=np.broadcast_to(x > -0.2, (50, 50, 50)).astype(np.uint16)
    )
    centers = np.asarray(splats, np.float64).reshape(-1, 3)
    writer.snapshot(0, splat_set(centers, np.full(len(centers), 0.01)), known(grid), grid.states(0.3, 0.7))
    return KeptMaps(writer, Config())


def shown(
    centers: ArrayLike, radius: float = 0.01, unrepresented: ArrayLike = (), label: Label = Label.OBJECT
) -> Any:
    """What a fitter has at a later time step."""
    points = np.asarray(centers, np.float64).reshape(-1, 3)
    splats = splat_set(points, np.full(len(points), radius), label)
    grid = plain_grid((50, 50, 50), VOXEL, -0.5)
    return SimpleNamespace(
        splats=lambda: splats, unrepresented=known(grid, 0, unrepresented, int(label)).unrepresented
    )


@pytest.mark.parametrize(
    ("before", "now", "is_new"),
    [
        pytest.param(FLOOR, shown(FLOOR), False, id="nothing new"),
        pytest.param(FLOOR, shown([*FLOOR, *THING]), True, id="a thing"),
        pytest.param(FLOOR, shown([*FLOOR, *THING[:2]]), False, id="noise"),
        pytest.param(FLOOR, shown(FLOOR, unrepresented=THING), True, id="a thing without a splat"),
        pytest.param(FLOOR, shown([*FLOOR, *(THING - [0.4, 0, 0])]), False, id="in space that was never seen"),
        pytest.param(FLOOR, shown(FLOOR + np.array([0, 0, 0.009])), False, id="half a voxel higher"),
        pytest.param(FLOOR, shown(FLOOR + np.array([0, 0, 0.012])), True, id="more than half a voxel higher"),
        pytest.param(FLOOR, shown(FLOOR, radius=0.025), True, id="grown"),
        pytest.param(FLOOR, shown([*FLOOR[:-9]]), False, id="gone"),
        pytest.param((), shown(THING), True, id="the first thing of all"),
        pytest.param(FLOOR, shown(THING, label=Label.ROBOT), False, id="the robot"),
    ],
)
def test_a_map_is_kept_for_something_new(tmp_path: Path, before: ArrayLike, now: Any, is_new: bool) -> None:
    assert kept(tmp_path / "scene", before).shows_news(now) == is_new


def test_before_the_first_map_nothing_is_new(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    assert not KeptMaps(SceneWriter(tmp_path / "scene", {}), Config()).shows_news(shown(THING))


CONFIG = Config(scene=SceneConfig(max_splats=600, first_iterations=20, refine_iterations=20))


@pytest.fixture(scope="module")
def views(sample_data: Path) -> list[RgbdFrame]:
    """Of a table from different places, in metres; every third row and column."""
    return [smaller(view) for view in views_of(sample_data)[:5]]


def smaller(frame: RgbdFrame) -> RgbdFrame:
    color, depth = (np.ascontiguousarray(image[::3, ::3]) for image in (frame.color, frame.depth))
    return replace(frame, color=color, depth=depth, intrinsics=strided_lens(frame.intrinsics, 3))


def written(folder: Path, views: list[RgbdFrame], *, poses: float, depths: float, **more: Any) -> Path:
    """The views as nerfstudio has them, with so many units of length a metre."""
    frames = []
    (folder / "images").mkdir(parents=True)
    for number, view in enumerate(views):
        T = view.T_world_camera.copy()
        T[:3, 3] *= poses
        color, depth = f"images/{number:02d}.png", f"images/{number:02d}_depth.png"
        cv2.imwrite(str(folder / color), view.color[..., ::-1])
        cv2.imwrite(str(folder / depth), np.round(view.depth * 1e4).astype(np.uint16))
        placed = {"transform_matrix": (T @ OPENGL_FROM_OPTICAL).tolist()}
        frames.append({"file_path": color, "depth_file_path": depth, **placed})
    k = views[0].intrinsics
    lens = {"fl_x": k.fx, "fl_y": k.fy, "cx": k.cx + 0.5, "cy": k.cy + 0.5, "w": k.width, "h": k.height}
    content = {"camera_model": "PINHOLE", "depth_unit_scale_factor": 1e-4 * depths, **lens, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def made(folder: Path, said: Progress | None = None, **more: Any) -> dict[str, Any]:
    """The metrics of its map."""
    request = ReconstructRequest(source=open_source(folder), out=folder / "scene", config=CONFIG, force=True)
    return dict(reconstruct(replace(request, **more), said or Said()).metrics)


def test_another_unit_gives_the_same_map_in_metres_and_is_said(tmp_path: Path, views: list[RgbdFrame]) -> None:
    one = made(written(tmp_path / "metres", views, poses=1.0, depths=1.0))
    assert one["psnr"] > 14
    for name, factor in (("millimetres", 1000.0), ("centimetres", 100.0)):
        folder, said = written(tmp_path / name, views, poses=factor, depths=factor), Said()
        other = made(folder, said)
        assert other["psnr"] == pytest.approx(one["psnr"], abs=0.1)
        assert other["workspace"] == pytest.approx(one["workspace"], rel=1e-3)
        line = f"warning: {name}: lengths are taken as {name}: the median depth is"
        assert any(words.startswith(line) for words in said.lines)
        assert name in open_source(folder).loss.notes[0]


def test_depth_alone_in_another_unit_is_refused_by_its_median(tmp_path: Path, views: list[RgbdFrame]) -> None:
    words = "is implausible (expected 0.05 to 20 m)"
    expect_refusal(words, made, written(tmp_path / "set", views, poses=1.0, depths=1000.0))


@pytest.mark.parametrize(
    ("poses", "depths", "factor"), [(1000, 1, "1000"), (100, 1000, "0.1"), (1000, 100, "10")], ids=str
)
def test_views_that_meet_in_another_unit_only_are_refused(
    tmp_path: Path, views: list[RgbdFrame], poses: float, depths: float, factor: str
) -> None:
    folder = written(tmp_path / "set", views, poses=poses, depths=depths)
    said = expect_refusal(rf"(do at|multiplied by) {factor}\b", made, folder)
    unit = re.search(r"give --depth-scale (\S+) \(it is (\S+) m per count\), or correct the poses' unit", said)
    assert float(unit[1]) == pytest.approx(float(unit[2]) * float(factor))
    found = check(CheckRequest(paths=(folder,)))[0].findings
    assert any(finding.code == "views-scale" and unit[0].partition(",")[0] in finding.remedy for finding in found)


def test_a_robot_is_in_metres_and_takes_no_guess(tmp_path: Path, views: list[RgbdFrame], plain_arm: Path) -> None:
    folder = written(tmp_path / "set", views, poses=1000.0, depths=1000.0)
    said = expect_refusal("lengths are taken as millimetres", made, folder, urdf=plain_arm / "tabletop/robot.urdf")
    assert "write poses and depth in metres, or leave the robot out" in said


def test_what_has_a_clock_is_in_metres(tmp_path: Path, views: list[RgbdFrame]) -> None:
    written(tmp_path / "set", views, poses=1000.0, depths=1000.0)
    description = 'root = "set"\n[poses]\nformat = "nerfstudio"\nfile = "transforms.json"\naxes = "opengl"\n'
    path = shapes.written(tmp_path, description + "[stamps]\nrate = 10.0\n", "set.toml")
    expect_refusal("is implausible", list, open_source(path).records())
