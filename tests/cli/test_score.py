"""``splatctrl score``: exit codes and what it prints, on a scene and a recording whose scores are known."""

from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.records import LossReport
from tests.jobs.wall import FRAMES, FakeScene, FakeSource, set_up, write_scene


@pytest.fixture
def scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, and the recording FRAMES."""
    return write_scene(tmp_path, monkeypatch)


def run(folder: Path, *arguments: object) -> int:
    return main(["score", str(folder / "scene"), "--reference", "fake.mcap", *map(str, arguments)])


def test_the_table_shows_each_view_and_the_mean(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "score: PASSED (3 views)"
    table = lines[lines.index("") + 1 :]
    assert table[0].split("  ")[0] == "view"
    assert [line.split()[0] for line in table[2:5]] == ["cam3-0001", "cam3-0002", "cam3-0003"]
    assert table[6].startswith("mean of 3")
    assert "3 views scored, 1 before the first snapshot" in lines[-2]
    assert lines[-1].startswith("in front: ")


def test_a_gate_that_fails_leaves_the_scores_and_exits_1(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored, "-o", scored / "score", "--require", "psnr_seen>=20", "--require", "psnr_all>=90") == 5
    assert "psnr_all is" in capsys.readouterr().err
    assert (scored / "score" / "score.json").is_file()


def test_a_gate_on_an_unknown_metric_is_refused_before_anything_is_rendered(
    scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeScene, "splats_at", lambda scene, stamp_ns: pytest.fail("rendered"))
    assert run(scored, "--require", "num_skipped<=1", "--require", "sharpness>=1") == 2


def test_damaged_input_exits_3(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES, loss=LossReport(damaged=1)))
    assert run(scored) == 3


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--cameras", "cam9"], 4, "fake.mcap: no camera 'cam9'; use one of: cam0, cam3"),
        (["--require", "sharpness>=1"], 2, "unknown metric; known here: num_views, valid_share, "),
        (["--require", "sharpness>=1"], 2, ", chamfer, accuracy_beyond, "),
        (["--require", "psnr_sen>=1"], 2, "unknown metric; did you mean psnr_seen?"),
        (["--require", "psnr_seen"], 2, "--require psnr_seen: expected METRIC>=NUMBER"),
        (["--require", "psnr_seen>=nan"], 2, "--require psnr_seen>=nan: expected METRIC>=NUMBER"),
        (["--scan", "scan1"], 2, "--scan scan1: only with --dtu"),
        (["--dtu", "root"], 2, "not allowed with argument"),
        (["--images", "all"], 2, "--images all: expected a folder for them; give -o"),
        (["--seed", "3"], 2, "--seed: only with --fit"),
        (["--fit-iterations", "3"], 2, "--fit-iterations: only with --fit"),
        (["--cloud-unit", "1"], 2, "--cloud-unit: only with --cloud"),
        (["--cloud", "a.ply", "--cloud-max", "0"], 2, "--cloud-max: expected 1e-06 to 1000 m, got '0'"),
    ],
)
def test_bad_usage_names_the_thing_and_the_choices(
    scored: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, message: str
) -> None:
    assert run(scored, *arguments) == code
    assert message in capsys.readouterr().err


def test_a_single_view_is_counted_as_one(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES[2:4]))
    assert run(scored) == 0
    assert "\n1 view scored, 0 before" in capsys.readouterr().out


def test_a_folder_that_is_no_scene_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(tmp_path), "--reference", "fake.mcap"]) == 4
    assert "expected a scene folder with splats.ply and run.json" in capsys.readouterr().err


def test_free_space_is_printed_and_gated(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (scored / "scene" / "occupancy.npz").touch()
    assert run(scored, "--require", "free_mass<=0.1") == 1
    out = capsys.readouterr().out
    assert "of the splats' mass is in space observed free" in out
    assert "in front" in out


def test_a_scene_that_cannot_be_compared_prints_one_line(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES[:2]))
    assert run(scored, "--json") == 5
    done = capsys.readouterr()
    assert done.out == "" and len(done.err.splitlines()) == 1
