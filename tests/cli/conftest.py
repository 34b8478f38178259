"""Fixtures of the tests of commands and replays."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from splatctrl_cli.checks import limits
from splatctrl_cli.cli.main import main
from splatctrl_cli.config import fixed
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.recordings import open_recording
from splatctrl_cli.jobs.replay import inputs, lockstep
from splatctrl_cli.recording.state import state_source
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import Desk, FakeSource, logged
from tests.field.scenes import cloud, splat_set
from tests.quick import painted, parsed_once, unpainted
from tests.recording.log.make_log import messages_of, write_raw

__all__ = ["painted", "parsed_once", "unpainted"]


@pytest.fixture(scope="module", autouse=True)
def few_points() -> Iterator[None]:
    """Compare fewer images and points of views, a fifth of a small fit; look around the arm every 3 cm, not 1."""
    few = {"VIEWS_PAIRS": 10, "VIEWS_POINTS": 400, "VIEWS_LANDED": 200, "EXPOSURE_FRAMES": 3}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in few.items():
            patch.setattr(limits, name, value)
        patch.setattr(fixed, "NEAR_MOVED", 0.03)
        yield


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reconstruct good recordings without the check before, a fifth of a small run."""
    monkeypatch.setattr(open_recording, "refuse_errors", lambda *_: None)


@pytest.fixture(scope="session")
def short_sample(sample_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The committed recording, 1.8 s of its 7: for commands and examples that are to run, whatever they find."""
    folder = tmp_path_factory.mktemp("short") / "sample_data"
    (folder / "tabletop").mkdir(parents=True)
    for path in (sample_data / "tabletop").iterdir():
        if path.name != "log.mcap":
            (folder / "tabletop" / path.name).symlink_to(path)
    messages = list(messages_of(sample_data / "tabletop" / "log.mcap"))
    end_ns = min(filter(None, (message.log_time_ns for message in messages))) + 1_800_000_000
    write_raw(folder / "tabletop" / "log.mcap", (each for each in messages if each.log_time_ns < end_ns))
    return folder


@pytest.fixture(scope="session")
def small_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated second of the tabletop in small images, and its scan."""
    folder = tmp_path_factory.mktemp("recording") / "small"
    size = ["--duration", "1.0", "--width", "96", "--height", "72", "--dtu"]
    assert main(["simulate", "-o", str(folder), *size, "-q"]) == 0
    return folder


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated second of the tabletop in the smallest images that show it."""
    folder = tmp_path_factory.mktemp("recording") / "tiny"
    size = ["--duration", "1.2", "--width", "64", "--height", "48", "-q"]
    assert main(["simulate", "-o", str(folder), *size]) == 0
    return folder


@pytest.fixture(scope="session")
def splats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cloud of 600 splats, as a file."""
    path = tmp_path_factory.mktemp("splats") / "splats.ply"
    centers, radii = cloud()
    write_ply(path, splat_set(centers, radii + 0.001), {})  # a PLY holds log radii
    return path


@pytest.fixture(scope="session")
def arm(plain_arm: Path) -> RobotModel:
    return RobotModel.from_urdf(plain_arm / "tabletop" / "robot.urdf", plain_arm / "tabletop" / "robot_spheres.yaml")


@pytest.fixture
def desk(tmp_path: Path, plain_arm: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
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
