"""Where a fit, a bake and a query compute. The card is the kernels on the processor, or a fake driver."""

import csv
import json
import re
import subprocess
import sys
from dataclasses import dataclass
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
BAKE = ("--box=-0.2,-0.15,-0.1,0.15,0.2,0.14", "--voxel", "0.02", "--formats", "npz", "--no-report")
NAME = "cuda:0 (Card, driver 580.1)"


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras above a floor, three time steps, a block from the second on."""
    frames = [
        frame(block=0.1 if k else 0.0, x=x, camera=f"cam{n}") for k in range(3) for n, x in enumerate((0.1, -0.1))
    ]
    return write_folder(tmp_path_factory.mktemp("recording") / "views", frames)


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("points") / "points.csv"
    np.savetxt(path, queries(40, extent=0.3), delimiter=",")
    return path


def cards(patch: pytest.MonkeyPatch, memory: Memory, name: str = "Card") -> None:
    """Let every card be this one."""
    card = Card(index=0, name=name, capability=(9, 0), driver="580.1")
    patch.setattr(device, "open_device", lambda *_: Device(name="cuda:0", card=card, memory=memory))


@pytest.fixture
def on_card(monkeypatch: pytest.MonkeyPatch) -> EmulatedDevice:
    memory = EmulatedDevice()
    cards(monkeypatch, memory)
    return memory


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Commands on one input; their outputs lie in a folder by name."""

    views: Path
    splats: Path
    points: Path
    folder: Path
    capsys: pytest.CaptureFixture[str]

    def main(self, code: int, *words: object) -> Any:
        """`out` and `err` of a command that ends with this code."""
        assert main([*map(str, words)]) == code
        return self.capsys.readouterr()

    def reconstruct(self, name: str, *options: str, code: int = 0) -> Any:
        return self.main(code, "reconstruct", self.views, "-o", self.folder / name, *FAST, *options)

    def bake(self, name: str, *options: object, code: int = 0) -> Any:
        return self.main(code, "sdf-bake", self.splats, "-o", self.folder / name, *BAKE, *options)

    def query(self, source: str | Path, *options: object, code: int = 0) -> Any:
        return self.main(code, "query", self.folder / source, self.points, *options)

    def metrics(self, name: str) -> dict[str, Any]:
        return dict(run_of(self.folder / name)["metrics"])

    def devices(self, name: str) -> list[str]:
        return [each["device"] for each in self.metrics(name)["devices"]]

    def stopped(self, name: str, *options: str) -> None:
        """A reconstruction that is stopped in its second time step."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(SceneFitter, "step", failing(SceneFitter.step, 2, KeyboardInterrupt()))
            self.reconstruct(name, *options, code=130)

    def are_alike(self, one: str, other: str) -> bool:
        return bool(contents(self.folder / one) == contents(self.folder / other))


@pytest.fixture
def bench(views: Path, splats: Path, points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Bench:
    return Bench(views=views, splats=splats, points=points, folder=tmp_path, capsys=capsys)


def run_of(scene: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((scene / "run.json").read_text())
    return found


CARD = {"device": "cuda:0", "card": "Card", "driver": "580.1"}
PROCESSOR = {"device": "cpu"}


def test_a_reconstruction_on_a_card_is_that_of_the_processor_and_says_so(
    bench: Bench, on_card: EmulatedDevice
) -> None:
    assert "computed on cuda:0 (Card, driver 580.1)" in bench.reconstruct("card", "--device", "cuda").out
    assert not on_card.sizes  # given back
    bench.reconstruct("again", "--device", "cuda:0", "-q")
    assert "computed on cpu" in bench.reconstruct("cpu", "--device", "cpu").out
    assert bench.are_alike("card", "again") and not bench.are_alike("card", "cpu")
    mine, other = bench.metrics("card"), bench.metrics("cpu")
    known = [[{**device, "from_iteration": 0}] for device in (CARD, PROCESSOR)]
    assert [mine["devices"], other["devices"]] == known
    assert (mine["splats"], mine["iterations"]) == (other["splats"], other["iterations"])
    assert mine["psnr"] == pytest.approx(other["psnr"], abs=0.1)  # [dB]
    assert mine["loss"] == pytest.approx(other["loss"], abs=2e-3)


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


@pytest.mark.usefixtures("on_card")
@pytest.mark.parametrize(("begins", "goes_on"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_run_that_one_device_began_goes_on_on_the_other(bench: Bench, begins: str, goes_on: str) -> None:
    bench.stopped("scene", "--device", begins)
    said, found = bench.reconstruct("scene", "--device", goes_on, "--resume"), bench.metrics("scene")
    known, names = {"cuda": CARD, "cpu": PROCESSOR}, {"cuda": "cuda:0 (Card, driver 580.1)", "cpu": "cpu"}
    began, went_on = ({**known[begins], "from_iteration": 0}, {**known[goes_on], "from_iteration": 6})
    assert (found["iterations"], found["devices"]) == (10, [began, went_on])
    assert f"computed on {names[begins]}, then {names[goes_on]}" in said.out
    assert "before iteration 6" in said.err and "for the bytes of one of them" in said.err


@pytest.mark.usefixtures("on_card")
def test_a_run_that_goes_on_on_its_card_has_the_bytes_of_one_that_was_not_stopped(bench: Bench) -> None:
    bench.stopped("scene", "--device", "cuda")
    bench.reconstruct("scene", "--device", "cuda", "--resume")
    bench.reconstruct("whole", "--device", "cuda")
    found = bench.metrics("scene")
    assert (found["iterations"], found["devices"]) == (10, [{**CARD, "from_iteration": 0}])
    assert bench.are_alike("scene", "whole")


def test_a_card_that_is_lost_ends_the_run_by_name_and_it_goes_on_elsewhere(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    cards(monkeypatch, Fails(15, DeviceError("CUDA_ERROR_ILLEGAL_ADDRESS")))
    (line,) = bench.reconstruct("scene", "--device", "cuda", "-q", code=70).err.splitlines()
    assert f"{NAME}: CUDA_ERROR_ILLEGAL_ADDRESS; " in line
    assert f"{bench.folder}/scene.partial is kept: continue with --resume" in line
    assert not (bench.folder / "scene").exists()
    bench.reconstruct("scene", "--device", "cpu", "--resume", "-q")
    assert bench.devices("scene") == ["cuda:0", "cpu"]


def test_a_card_that_is_lost_at_once_leaves_nothing_and_no_silent_fallback(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "CARD_LEAST_WORK", 0)
    cards(monkeypatch, Fails(0, DeviceError("CUDA_ERROR_LAUNCH_FAILED")))
    said = bench.reconstruct("scene", "-q", code=70)
    assert "CUDA_ERROR_LAUNCH_FAILED; start over, with --device cpu" in said.err
    assert not list(bench.folder.iterdir())


def test_too_little_memory_is_refused_with_the_budget_that_fits(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    cards(monkeypatch, EmulatedDevice(limit=2_000_000))
    said = bench.reconstruct("scene", "--device", "cuda", "--max-splats", "3000", "-q", code=2)
    found = re.search(r"out of memory: 3000 splats.* a budget of (\d+) ", said.err)
    bench.reconstruct("scene", "--device", "cuda", "--max-splats", found[1], "-q")


def test_auto_takes_a_card_where_its_work_is_worth_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, on_card: EmulatedDevice
) -> None:
    assert "computes on the CPU (400 splats on 4800 pixels are too little work" in bench.reconstruct("small").err
    monkeypatch.setattr(device, "CARD_LEAST_WORK", 400 * 4800)
    assert "computes on cuda:0 (Card, driver 580.1)" in bench.reconstruct("large").err
    on_card.limit = 1_500_000
    assert "computes on the CPU (too little memory is free on the card" in bench.reconstruct("full").err
    assert [bench.devices(name) for name in ("small", "large", "full")] == [["cpu"], ["cuda:0"], ["cpu"]]


def lack_card(*_: str) -> Device:
    raise DeviceError("no NVIDIA driver")


@pytest.mark.parametrize(
    ("begins", "has_card", "ends"),
    [("cpu", True, ["cpu"]), ("cuda", True, ["cuda:0"]), ("cuda", False, ["cuda:0", "cpu"])],
)
def test_auto_goes_on_where_the_run_was(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, begins: str, has_card: bool, ends: list[str]
) -> None:
    monkeypatch.setattr(device, "CARD_LEAST_WORK", 0)
    cards(monkeypatch, Fails(15, DeviceError("CUDA_ERROR_DEVICE_LOST")))
    if begins == "cpu":
        bench.stopped("scene", "--device", "cpu")
    else:
        bench.reconstruct("scene", "--device", "cuda", "-q", code=70)
    cards(monkeypatch, EmulatedDevice())
    if not has_card:
        monkeypatch.setattr(device, "open_device", lack_card)
    said = bench.reconstruct("scene", "--resume")
    assert (bench.devices("scene"), "computes on the CPU (no NVIDIA driver" in said.err) == (ends, not has_card)


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
    case: str, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_installed, fake, message = REFUSED[case]
    monkeypatch.setattr(device, "is_installed", lambda module: bool(is_installed))
    monkeypatch.setattr(driver, "LIBRARY", "libcuda_of_no_machine.so.1")
    if fake is not None:
        fake.install(monkeypatch)
        monkeypatch.setattr(driver, "LIBRARY", "libcuda.so.1")
    (line,) = bench.reconstruct("out", "--device", "cuda", code=2).err.splitlines()
    assert message in line and line.endswith("or give --device cpu")
    assert not list(bench.folder.iterdir())


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


def test_a_bake_on_a_card_is_that_of_the_processor_and_says_so(bench: Bench, on_card: EmulatedDevice) -> None:
    for name, chosen in (("card", "cuda"), ("again", "cuda:0"), ("cpu", "cpu"), ("auto", "auto")):
        bench.bake(name, "--device", chosen, "-q")
    assert not on_card.sizes  # given back
    assert bench.are_alike("card", "again") and bench.are_alike("cpu", "auto")
    devices = {name: bench.metrics(name)["devices"] for name in ("card", "cpu", "auto")}
    assert devices == {"card": [CARD], "cpu": [PROCESSOR], "auto": [PROCESSOR]}
    mine, theirs = (read_npz(bench.folder / name / "field.npz").channels for name in ("card", "cpu"))
    np.testing.assert_allclose(mine["sdf"], theirs["sdf"], rtol=0, atol=1e-4)
    np.testing.assert_allclose(mine["bound"], theirs["bound"], rtol=0, atol=1e-6)
    assert not np.array_equal(mine["gradient"], theirs["gradient"])


@pytest.mark.usefixtures("on_card")
def test_auto_bakes_on_a_card_where_its_work_is_worth_it(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "computes on" not in bench.bake("small").err
    monkeypatch.setattr(bake_request, "CARD_LEAST_BAKE", 4693 * bake_request.CARD_SPLATS)
    assert f"computes on {NAME}" in bench.bake("large").err
    assert "computes on" not in bench.bake("updated", "--update", bench.folder / "small").err
    bench.bake("matern", "--distance", "gpdf")  # fewer splats
    assert bench.metrics("updated")["devices"] == bench.metrics("matern")["devices"] == [PROCESSOR]


def test_a_card_that_cannot_be_used_is_refused_by_name(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "LIBRARY", "libcuda_of_no_machine.so.1")
    assert "--device cuda: " in bench.bake("field", "--device", "cuda", "-q", code=2).err
    assert "--device cuda:1: " in bench.query(bench.splats, "--device", "cuda:1", "-q", code=2).err
    assert not list(bench.folder.iterdir())


@pytest.mark.usefixtures("on_card")
def test_what_the_processor_alone_does_is_refused_on_a_card(bench: Bench) -> None:
    bench.bake("field", "-q")
    said = bench.bake("new", "--update", bench.folder / "field", "--device", "cuda", "-q", code=2)
    assert "--update bakes on the processor" in said.err
    said = bench.query("field", "--device", "cuda", "-q", code=2)
    assert "a baked field is read on the processor" in said.err


def test_a_card_that_is_lost_ends_the_bake_by_name_and_another_device_does_not_go_on(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    cards(monkeypatch, Fails(0, DeviceError("CUDA_ERROR_ILLEGAL_ADDRESS")))
    (line,) = bench.bake("field", "--device", "cuda", "-q", code=70).err.splitlines()
    assert f"{NAME}: CUDA_ERROR_ILLEGAL_ADDRESS; " in line
    assert not (bench.folder / "field").exists()


@pytest.mark.usefixtures("on_card")
def test_a_query_on_a_card_has_the_answers_of_the_processor(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = {}
    for name in ("cpu", "cuda", "auto"):
        assert "computes on" not in bench.query(bench.splats, "-o", bench.folder / name, "--device", name).err
        answers[name] = list(csv.DictReader((bench.folder / name).read_text().splitlines()))
    assert answers["auto"] == answers["cpu"]
    names = ("distance", "bound", "surface_z")
    for mine, theirs in zip(answers["cuda"], answers["cpu"], strict=True):
        assert mine["splat"] == theirs["splat"]
        assert [float(mine[n]) for n in names] == pytest.approx([float(theirs[n]) for n in names], abs=2e-4)
    monkeypatch.setattr(query, "CARD_LEAST_TABLE", 100)
    assert f"computes on {NAME}" in bench.query(bench.splats, "-o", bench.folder / "large").err
    assert (bench.folder / "large").read_bytes() == (bench.folder / "cuda").read_bytes()
