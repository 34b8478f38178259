"""``splatctrl reconstruct`` on a small simulated log."""

from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main

FAST = ["--max-splats", "800", "--set", "scene.first_iterations=30", "--set", "scene.iterations_per_step=5", "-q"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording") / "small"
    size = ["--duration", "1.0", "--width", "128", "--height", "96"]
    assert main(["simulate", "-o", str(folder), *size, "--dtu", "-q"]) == 0
    return folder


def reconstruct(recording: Path, out: Path, *options: str) -> int:
    robot = ["--urdf", str(recording / "robot.urdf"), "--spheres", str(recording / "robot_spheres.yaml")]
    log = [str(recording / "log.mcap"), "--cameras", "cam0,cam1,cam2"]
    return main(["reconstruct", *log, *robot, "-o", str(out), *FAST, *options])


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "run.json"
    }


def test_one_thread_and_two_give_the_same_bytes(recording: Path, tmp_path: Path) -> None:
    for name, threads in (("one", "1"), ("two", "2"), ("again", "2")):
        assert reconstruct(recording, tmp_path / name, "--threads", threads) == 0
    one = contents(tmp_path / "one")
    assert set(one) > {"splats.ply", "occupancy.npz", "audit.jsonl", "snapshots.csv", "checkpoint/state.npz"}
    assert one == contents(tmp_path / "two") == contents(tmp_path / "again")
    assert reconstruct(recording, tmp_path / "other", "--seed", "1") == 0
    assert contents(tmp_path / "other")["splats.ply"] != one["splats.ply"]


def test_gates_decide_the_exit_code(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reconstruct(recording, tmp_path / "a", "--require", "psnr>=10") == 0
    assert reconstruct(recording, tmp_path / "b", "--require", "psnr>=99") == 1
    assert "psnr is" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["LOG", "--device", "cuda"], 2, "no CUDA kernels"),
        (["LOG", "--spheres", "x.yaml"], 2, "give its --urdf"),
        (["LOG", "--max-splats", "0"], 2, "--max-splats"),
        (["LOG", "--box", "1,2,3"], 2, "x0,y0,z0,x1,y1,z1"),
        (["LOG", "--box=0,0,0,1,1,-1"], 2, "x0 < x1"),
        (["LOG", "--cameras", "cam9"], 4, "cam0"),
        (["LOG", "--box=50,50,50,51,51,51"], 4, "no pixel"),
        (["--dtu", "DTU", "--holdout", "a"], 2, "'a'"),
        (["LOG", "--require", "pnsr>=3"], 2, "did you mean psnr"),
        ([], 2, "SOURCE"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], code: int, said: str
) -> None:
    words = {"LOG": str(recording / "log.mcap"), "DTU": str(recording / "dtu")}
    given = [words.get(option, option) for option in options]
    assert main(["reconstruct", *given, "-o", str(tmp_path / "out"), "-q"]) == code
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_views_that_trained_a_scene_are_not_scored_as_held_out(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, dtu = str(tmp_path / "scene"), str(recording / "dtu")
    fast = [*FAST, "--set", "scene.refine_iterations=20"]
    assert main(["reconstruct", "--dtu", dtu, "--holdout", "1", "-o", scene, *fast]) == 0
    assert main(["score", scene, "--dtu", dtu, "--holdout", "1", "-q"]) == 0
    capsys.readouterr()
    assert main(["score", scene, "--dtu", dtu, "--holdout", "2", "-q"]) == 2
    assert "trained the scene" in capsys.readouterr().err


def test_an_output_that_is_or_holds_the_input_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = recording / "log.mcap"
    before = log.read_bytes()
    for out in (log, recording):
        assert main(["reconstruct", str(log), "-o", str(out), "--force", "-q"]) == 2
        assert "would replace the input" in capsys.readouterr().err
    assert log.read_bytes() == before
