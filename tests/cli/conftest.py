"""What replays share."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from splatctrl_cli.jobs.replay import files, inputs, lockstep
from splatctrl_cli.recording.state import state_source
from splatctrl_cli.records import SphereSet
from splatctrl_cli.robot import coverage
from splatctrl_cli.robot.link_meshes import Solid
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.urdf import UrdfFile
from tests.cli.replay_desk import Desk, FakeSource, logged

Solids = Mapping[str, Sequence[Solid]]
MEASURED: dict[tuple[bytes, ...], coverage.CoverageReport] = {}


@pytest.fixture
def coverage_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What spheres leave uncovered of a robot without meshes is measured once: that takes longer than a replay."""
    measure = coverage.coverage_of_solids

    def known(urdf: UrdfFile, solids: Solids, spheres: SphereSet, **how: Any) -> coverage.CoverageReport:
        text = urdf.text.encode()
        if b"<mesh" in text:
            return measure(urdf, solids, spheres, **how)
        names = repr((how, spheres.links)).encode()
        key = (text, names, spheres.centers.tobytes(), spheres.radii.tobytes())
        if key not in MEASURED:
            MEASURED[key] = measure(urdf, solids, spheres, **how)
        return MEASURED[key]

    monkeypatch.setattr(inputs, "coverage_of_solids", known)


@pytest.fixture
def without_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of other files of the output."""
    monkeypatch.setattr(files, "draw_replay", lambda *_: None)


@pytest.fixture
def unpainted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made in full, but neither laid out nor painted, which takes longer than a replay; `painted` are."""
    if request.node.get_closest_marker("painted") is None:
        monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: Path(path).touch())


@pytest.fixture
def arm(plain_arm: Path) -> RobotModel:
    return RobotModel.from_urdf(plain_arm / "tabletop" / "robot.urdf", plain_arm / "tabletop" / "robot_spheres.yaml")


@pytest.fixture
def desk(tmp_path: Path, plain_arm: Path, monkeypatch: pytest.MonkeyPatch, coverage_once: None) -> Desk:
    tabletop = plain_arm / "tabletop"
    robot = ["--urdf", str(tabletop / "robot.urdf"), "--spheres", str(tabletop / "robot_spheres.yaml")]
    desk = Desk(folder=tmp_path, source=FakeSource(states=logged()), robot=robot)
    opened = state_source.open_states
    for module in (inputs, lockstep):
        monkeypatch.setattr(
            module,
            "open_states",
            lambda path, *rest: desk.source if path.name == desk.source.name else opened(path, *rest),
        )
    return desk
