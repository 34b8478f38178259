"""Where a fit, a bake and a query compute. The card is the kernels on the processor, or a fake driver."""

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.jobs.bake import request as bake_request
from splatctrl_cli.jobs.query import query
from splatctrl_cli.jobs.running import device
from splatctrl_cli.jobs.running.device import Device
from splatctrl_cli.kernels.cuda import memory as driver
from splatctrl_cli.kernels.cuda.memory import Array, Card, DeviceError, Memory
from splatctrl_cli.scene.fitter import SceneFitter
from tests.cli.test_reconstruct import contents, write_folder
from tests.field.scenes import queries
from tests.jobs.stage import failing
from tests.kernels.cuda.emulator import EmulatedDevice
from tests.kernels.cuda.test_driver import FakeDriver
from tests.scene.wall import frame

pytestmark = pytest.mark.usefixtures("unchecked")

FAST = [
    *("--box=-0.45,-0.35,-0.05,0.45,0.35,0.6", "--max-splats", "400", "--set", "scene.first_iterations=6"),
    *("--set", "scene.iterations_per_step=2", "--set", "scene.checkpoint_period=0"),
]


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras above a floor, three time steps, a block from the second on."""
    frames = [
        frame(block=0.1 if k else 0.0, x=x, camera=f"cam{n}") for k in range(3) for n, x in enumerate((0.1, -0.1))
    ]
    return write_folder(tmp_path_factory.mktemp("recording") / "views", frames)


def cards(patch: pytest.MonkeyPatch, memory: Memory, name: str = "Card") -> None:
    """Let every card be this one."""
    card = Card(index=0, name=name, capability=(9, 0), driver="580.1")
    patch.setattr(device, "open_device", lambda *_: Device(name="cuda:0", card=card, memory=memory))


@pytest.fixture
def on_card(monkeypatch: pytest.MonkeyPatch) -> EmulatedDevice:
    memory = EmulatedDevice()
    cards(monkeypatch, memory)
    return memory


def reconstruct(views: Path, out: Path, *options: str) -> int:
    return main(["reconstruct", str(views), "-o", str(out), *FAST, *options])


def run_of(scene: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((scene / "run.json").read_text())
    return found


CARD = {"device": "cuda:0", "card": "Card", "driver": "580.1"}
PROCESSOR = {"device": "cpu"}


def test_a_reconstruction_on_a_card_is_that_of_the_processor_and_says_so(
    views: Path, tmp_path: Path, on_card: EmulatedDevice, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reconstruct(views, tmp_path / "card", "--device", "cuda") == 0
    assert "computed on cuda:0 (Card, driver 580.1)" in capsys.readouterr().out
    assert not on_card.sizes  # given back
    assert reconstruct(views, tmp_path / "again", "--device", "cuda:0", "-q") == 0
    assert contents(tmp_path / "card") == contents(tmp_path / "again")
    capsys.readouterr()
    assert reconstruct(views, tmp_path / "cpu", "--device", "cpu") == 0
    assert "computed on cpu" in capsys.readouterr().out
    assert contents(tmp_path / "card") != contents(tmp_path / "cpu")
    mine, other = run_of(tmp_path / "card")["metrics"], run_of(tmp_path / "cpu")["metrics"]
    assert mine["devices"] == [{**CARD, "from_iteration": 0}]
    assert other["devices"] == [{**PROCESSOR, "from_iteration": 0}]
    assert (mine["splats"], mine["iterations"]) == (other["splats"], other["iterations"])
    assert abs(mine["psnr"] - other["psnr"]) < 0.1  # [dB]
    assert abs(mine["loss"] - other["loss"]) < 2e-3


class Fails(EmulatedDevice):
    """A card that is lost at its n-th copy to the host."""

    def __init__(self, reads: int, error: DeviceError) -> None:
        super().__init__()
        self.reads, self.error = reads, error

    def read(self, address: int, out: Array) -> None:
        self.reads -= 1
        if self.reads < 0:
            raise self.error
        super().read(address, out)


@pytest.mark.parametrize(("begins", "goes_on"), [("cuda", "cpu"), ("cpu", "cuda"), ("cuda", "cuda")])
def test_a_run_that_one_device_began_goes_on_on_the_other(
    views: Path,
    tmp_path: Path,
    on_card: EmulatedDevice,
    capsys: pytest.CaptureFixture[str],
    begins: str,
    goes_on: str,
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SceneFitter, "step", failing(SceneFitter.step, 2, KeyboardInterrupt()))
        assert reconstruct(views, tmp_path / "scene", "--device", begins) == 130
    capsys.readouterr()
    assert reconstruct(views, tmp_path / "scene", "--device", goes_on, "--resume") == 0
    found, (out, err) = run_of(tmp_path / "scene")["metrics"], capsys.readouterr()
    known = {"cuda": CARD, "cpu": PROCESSOR}
    assert found["iterations"] == 10
    if begins == goes_on:
        assert found["devices"] == [{**CARD, "from_iteration": 0}]
        assert reconstruct(views, tmp_path / "whole", "--device", begins) == 0
        assert contents(tmp_path / "scene") == contents(tmp_path / "whole")
        return
    assert found["devices"] == [{**known[begins], "from_iteration": 0}, {**known[goes_on], "from_iteration": 6}]
    assert "before iteration 6" in err and "for the bytes of one of them" in err
    names = {"cuda": "cuda:0 (Card, driver 580.1)", "cpu": "cpu"}
    assert f"computed on {names[begins]}, then {names[goes_on]}" in out


def test_a_card_that_is_lost_ends_the_run_by_name_and_it_goes_on_elsewhere(
    views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cards(monkeypatch, Fails(15, DeviceError("CUDA_ERROR_ILLEGAL_ADDRESS")))
    assert reconstruct(views, tmp_path / "scene", "--device", "cuda", "-q") == 70
    (line,) = capsys.readouterr().err.splitlines()
    assert "cuda:0 (Card, driver 580.1): CUDA_ERROR_ILLEGAL_ADDRESS; " in line
    assert f"{tmp_path}/scene.partial is kept: continue with --resume" in line
    assert not (tmp_path / "scene").exists()
    assert reconstruct(views, tmp_path / "scene", "--device", "cpu", "--resume", "-q") == 0
    assert [each["device"] for each in run_of(tmp_path / "scene")["metrics"]["devices"]] == ["cuda:0", "cpu"]


def test_a_card_that_is_lost_at_once_leaves_nothing_and_no_silent_fallback(
    views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(device, "CARD_LEAST_WORK", 0)
    cards(monkeypatch, Fails(0, DeviceError("CUDA_ERROR_LAUNCH_FAILED")))
    assert reconstruct(views, tmp_path / "scene", "-q") == 70
    assert "CUDA_ERROR_LAUNCH_FAILED; start over, with --device cpu" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_too_little_memory_is_refused_with_the_budget_that_fits(
    views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cards(monkeypatch, EmulatedDevice(limit=2_000_000))
    assert reconstruct(views, tmp_path / "scene", "--device", "cuda", "--max-splats", "3000", "-q") == 2
    err = capsys.readouterr().err
    assert "out of memory: 3000 splats" in err
    fits = err.partition("a budget of ")[2].partition(" ")[0]
    assert reconstruct(views, tmp_path / "scene", "--device", "cuda", "--max-splats", fits, "-q") == 0


def test_auto_takes_a_card_where_its_work_is_worth_it(
    views: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    on_card: EmulatedDevice,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert reconstruct(views, tmp_path / "small") == 0
    assert "computes on cpu: 400 splats on 4800 pixels are too little work" in capsys.readouterr().err
    monkeypatch.setattr(device, "CARD_LEAST_WORK", 400 * 4800)
    assert reconstruct(views, tmp_path / "large") == 0
    assert "computes on cuda:0 (Card, driver 580.1)" in capsys.readouterr().err
    on_card.limit = 1_500_000
    assert reconstruct(views, tmp_path / "full") == 0
    assert "computes on cpu: too little memory is free on the card" in capsys.readouterr().err
    devices = [run_of(tmp_path / name)["metrics"]["devices"][0]["device"] for name in ("small", "large", "full")]
    assert devices == ["cpu", "cuda:0", "cpu"]


def test_auto_goes_on_where_the_run_was(
    views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(device, "CARD_LEAST_WORK", 0)

    def no_card(*_: str) -> Device:
        raise DeviceError("no NVIDIA driver")

    for name, begins, has_card, ends in (
        *(("a", "cpu", True, ["cpu"]), ("b", "cuda", True, ["cuda:0"])),
        ("c", "cuda", False, ["cuda:0", "cpu"]),
    ):
        cards(monkeypatch, Fails(15, DeviceError("CUDA_ERROR_DEVICE_LOST")))
        with pytest.MonkeyPatch.context() as patch:
            if begins == "cpu":
                patch.setattr(SceneFitter, "step", failing(SceneFitter.step, 2, KeyboardInterrupt()))
            assert reconstruct(views, tmp_path / name, "--device", begins, "-q") in (70, 130)
        cards(monkeypatch, EmulatedDevice())
        if not has_card:
            monkeypatch.setattr(device, "open_device", no_card)
        capsys.readouterr()
        assert reconstruct(views, tmp_path / name, "--resume") == 0
        assert [each["device"] for each in run_of(tmp_path / name)["metrics"]["devices"]] == ends
        assert ("computes on cpu: no NVIDIA driver" in capsys.readouterr().err) == (not has_card)


REFUSED = {
    "no extra": (None, None, r"--device cuda: the extra [cuda] is not installed (cuda.core); pip install"),
    "no driver": (True, None, "--device cuda: no NVIDIA driver (libcuda_of_no_machine"),
    "too old": (True, FakeDriver(12040), "the driver is too old: for CUDA 12.4, expected 13.0; install 580 or later"),
    "no card": (
        True,
        FakeDriver(init=100),
        "the driver finds no card (CUDA_ERROR_NO_DEVICE); see what nvidia-smi says",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_card_that_cannot_be_used_is_refused_before_anything_is_read(
    case: str, views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    is_installed, fake, message = REFUSED[case]
    monkeypatch.setattr(device, "is_installed", lambda module: bool(is_installed))
    monkeypatch.setattr("splatctrl_cli.kernels.cuda.memory.LIBRARY", "libcuda_of_no_machine.so.1")
    if fake is not None:
        fake.install(monkeypatch)
        monkeypatch.setattr("splatctrl_cli.kernels.cuda.memory.LIBRARY", "libcuda.so.1")
    assert main(["reconstruct", str(views), "-o", str(tmp_path / "out"), "--device", "cuda"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line and line.endswith("or give --device cpu")
    assert not list(tmp_path.iterdir())


def test_without_the_extra_auto_imports_nothing_and_takes_no_time() -> None:
    """A process of its own, without the extra: this one may have it."""
    code = """
import sys, time
from splatctrl_cli.jobs.running import device
sys.modules["cuda"] = None
before, start = set(sys.modules), time.perf_counter()
try:
    device.open_device("cuda")
except Exception as error:
    print(f"{1e3 * (time.perf_counter() - start):.2f}", sorted(set(sys.modules) - before), error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    milliseconds, modules, error = done.stdout.split(" ", 2)
    assert float(milliseconds) < 5.0
    assert (modules, error) == ("[]", "the extra [cuda] is not installed (cuda.core)\n")


BAKE = ("--box=-0.2,-0.15,-0.1,0.15,0.2,0.14", "--voxel", "0.02", "--formats", "npz", "--no-report")
NAME = "cuda:0 (Card, driver 580.1)"


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("points") / "points.csv"
    np.savetxt(path, queries(40, extent=0.3), delimiter=",")
    return path


def bake(splats: Path, out: Path, *options: str) -> int:
    return main(["sdf-bake", str(splats), "-o", str(out), *BAKE, *options])


def test_a_bake_on_a_card_is_that_of_the_processor_and_says_so(
    splats: Path, tmp_path: Path, on_card: EmulatedDevice
) -> None:
    for name, chosen in (("card", "cuda"), ("again", "cuda:0"), ("cpu", "cpu"), ("auto", "auto")):
        assert bake(splats, tmp_path / name, "--device", chosen, "-q") == 0
    assert not on_card.sizes  # given back
    assert contents(tmp_path / "card") == contents(tmp_path / "again")
    assert contents(tmp_path / "cpu") == contents(tmp_path / "auto")
    devices = {name: run_of(tmp_path / name)["metrics"]["devices"] for name in ("card", "cpu", "auto")}
    assert devices == {"card": [CARD], "cpu": [PROCESSOR], "auto": [PROCESSOR]}
    mine, theirs = (read_npz(tmp_path / name / "field.npz").channels for name in ("card", "cpu"))
    np.testing.assert_allclose(mine["sdf"], theirs["sdf"], rtol=0, atol=1e-4)
    np.testing.assert_allclose(mine["bound"], theirs["bound"], rtol=0, atol=1e-6)
    assert not np.array_equal(mine["gradient"], theirs["gradient"])


def test_auto_bakes_on_a_card_where_its_work_is_worth_it(
    splats: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    on_card: EmulatedDevice,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bake(splats, tmp_path / "small") == 0
    assert "computes on" not in capsys.readouterr().err
    monkeypatch.setattr(bake_request, "CARD_LEAST_BAKE", 4693 * bake_request.CARD_SPLATS)
    assert bake(splats, tmp_path / "large") == 0
    assert f"computes on {NAME}" in capsys.readouterr().err
    assert bake(splats, tmp_path / "updated", "--update", str(tmp_path / "small")) == 0
    assert run_of(tmp_path / "updated")["metrics"]["devices"] == [PROCESSOR]
    assert "computes on" not in capsys.readouterr().err
    assert bake(splats, tmp_path / "matern", "--distance", "gpdf") == 0  # fewer splats
    assert run_of(tmp_path / "matern")["metrics"]["devices"] == [PROCESSOR]


def test_a_card_that_cannot_be_used_is_refused_by_name(
    splats: Path, points: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(driver, "LIBRARY", "libcuda_of_no_machine.so.1")
    assert bake(splats, tmp_path / "field", "--device", "cuda", "-q") == 2
    assert "--device cuda: " in capsys.readouterr().err
    assert main(["query", str(splats), str(points), "--device", "cuda:1", "-q"]) == 2
    assert "--device cuda:1: " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_the_processor_alone_does_is_refused_on_a_card(
    splats: Path, points: Path, tmp_path: Path, on_card: EmulatedDevice, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bake(splats, tmp_path / "field", "-q") == 0
    assert bake(splats, tmp_path / "new", "--update", str(tmp_path / "field"), "--device", "cuda", "-q") == 2
    assert "--update bakes on the processor" in capsys.readouterr().err
    assert main(["query", str(tmp_path / "field"), str(points), "--device", "cuda", "-q"]) == 2
    assert "a baked field is read on the processor" in capsys.readouterr().err


def test_a_card_that_is_lost_ends_the_bake_by_name_and_another_device_does_not_go_on(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cards(monkeypatch, Fails(0, DeviceError("CUDA_ERROR_ILLEGAL_ADDRESS")))
    assert bake(splats, tmp_path / "field", "--device", "cuda", "-q") == 70
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{NAME}: CUDA_ERROR_ILLEGAL_ADDRESS; " in line
    assert not (tmp_path / "field").exists()


def test_a_query_on_a_card_has_the_answers_of_the_processor(
    splats: Path,
    points: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    on_card: EmulatedDevice,
    capsys: pytest.CaptureFixture[str],
) -> None:
    answers = {}
    for name in ("cpu", "cuda", "auto"):
        assert main(["query", str(splats), str(points), "-o", str(tmp_path / name), "--device", name]) == 0
        answers[name] = list(csv.DictReader((tmp_path / name).read_text().splitlines()))
    assert capsys.readouterr().err.count("computes on") == 0
    assert answers["auto"] == answers["cpu"]
    for mine, theirs in zip(answers["cuda"], answers["cpu"], strict=True):
        assert mine["splat"] == theirs["splat"]
        for name in ("distance", "bound", "surface_z"):
            assert abs(float(mine[name]) - float(theirs[name])) < 2e-4
    monkeypatch.setattr(query, "CARD_LEAST_TABLE", 100)
    assert main(["query", str(splats), str(points), "-o", str(tmp_path / "large")]) == 0
    assert f"computes on {NAME}" in capsys.readouterr().err
    assert (tmp_path / "large").read_bytes() == (tmp_path / "cuda").read_bytes()
