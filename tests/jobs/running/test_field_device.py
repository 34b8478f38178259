"""Where `sdf-bake` and `query` compute. The card is the kernels on the processor (tests/kernels/cuda)."""

import csv
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.bake import request as bake_request
from splatctrl_cli.jobs.query import query
from splatctrl_cli.kernels.cuda import driver
from splatctrl_cli.kernels.cuda.memory import DeviceError
from tests.cli.test_reconstruct import contents
from tests.field.scenes import cloud, queries, splat_set
from tests.jobs.running.test_device import CARD, PROCESSOR, Fails, cards, run_of
from tests.kernels.cuda.emulator import EmulatedDevice

BAKE = ("--box=-0.2,-0.15,-0.1,0.15,0.2,0.14", "--voxel", "0.02", "--formats", "npz", "--no-report")
NAME = "cuda:0 (Card, driver 580.1)"


@pytest.fixture(scope="module")
def splats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("splats") / "splats.ply"
    centers, radii = cloud(300)
    write_ply(path, splat_set(centers, np.maximum(radii, 0.002)), {})
    return path


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("points") / "points.csv"
    np.savetxt(path, queries(40, extent=0.3), delimiter=",")
    return path


@pytest.fixture
def on_card(monkeypatch: pytest.MonkeyPatch) -> EmulatedDevice:
    memory = EmulatedDevice()
    cards(monkeypatch, memory)
    return memory


def bake(splats: Path, out: Path, *options: str) -> int:
    return main(["sdf-bake", str(splats), "-o", str(out), *BAKE, *options])


def test_a_bake_on_a_card_is_that_of_the_processor_and_says_so(
    splats: Path, tmp_path: Path, on_card: EmulatedDevice
) -> None:
    for name, device in (("card", "cuda"), ("again", "cuda:0"), ("cpu", "cpu"), ("auto", "auto")):
        assert bake(splats, tmp_path / name, "--device", device, "-q") == 0
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
