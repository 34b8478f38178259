"""A box that the hand carries, declared and not: from the recording through the reconstruction to the verdict."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import load_config
from splatctrl_cli.jobs.reconstruct.reconstruct import ReconstructResult, reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.records import Record
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions
from tests.cli.replay_desk import START, Desk, FakeSource
from tests.jobs.bake.baked import Said
from tests.jobs.stage import MOVE, Stage, states_on

pytestmark = pytest.mark.usefixtures("without_plots")
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
    urdf = tmp_path_factory.mktemp("carrying") / "robot.urdf"
    text = (tabletop / "robot.urdf").read_text()
    assert text.count('<link name="hand">') == 1
    urdf.write_text(text.replace('<link name="hand">', f'<link name="hand">{HELD}'))
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
    path = folder / "declared.toml"
    path.write_text("".join(entries))
    return path


def mapped(stage: Stage, declare: Path | None, progress: Progress = SILENT) -> ReconstructResult:
    urdf, spheres = Path(stage.desk.robot[1]), Path(stage.desk.robot[3])
    settings = ["scene.max_splats=3000", "scene.first_iterations=10", "scene.iterations_per_step=3"]
    request = ReconstructRequest(
        source=stage.desk.source,
        out=stage.desk.folder / "scene",
        config=load_config(None, settings),
        urdf=urdf,
        spheres=spheres,
        declare=declare,
        threads=1,
    )
    return reconstruct(request, progress)


def test_a_box_that_is_declared_is_no_obstacle_and_listed_by_every_verdict(stage: Stage, tmp_path: Path) -> None:
    """The declared box is a centimetre larger than the cube on every side; a second one holds nothing."""
    declare = declared(tmp_path, BOX, "[0.5, 0.5, 0.5, 0.6, 0.6, 0.6]")
    heard = Said()
    found = mapped(stage, declare, heard)
    scene = stage.desk.folder / "scene"
    code, verdict = stage.judged("--declare", str(declare), scene=scene)
    assert (code, verdict["label"]) == (0, "safe"), verdict["sentence"]
    for notes in (found.verdict.notes, verdict["notes"]):
        used, unused = (note for note in notes if "carries a box" in note)
        assert re.fullmatch(r"hand carries a box from 0 to 9 s: [1-9]\d+ points", used)
        assert (
            unused == "hand carries a box from 0 to 9 s: warning: no pixel of any frame needed it; check link and box"
        )
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
    assert code == 1
    said = (
        "hand carries a box: warning: the map was made without this declaration; give reconstruct the same --declare"
    )
    assert said in verdict["notes"]


def test_links_that_spheres_stand_for_are_named(stage: Stage, tmp_path: Path) -> None:
    text = Path(stage.desk.robot[1]).read_text()
    start = text.index('<link name="hand">')
    other = tmp_path / "other.urdf"
    other.write_text(text[:start] + text[start:].replace("<box ", "<cone "))
    heard = Said()
    mapped(stage, None, heard)
    assert not [line for line in heard.lines if "spheres stand for" in line]
    stage.desk.robot[1], stage.desk.folder = str(other), tmp_path / "again"
    mapped(stage, None, heard)
    said = f"warning: spheres stand for hand: {other}: <cone> cannot be read; correct the URDF"
    assert said in heard.lines
