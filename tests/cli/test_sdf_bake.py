import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.cli import run_options, scene_options
from splatctrl_cli.cli.scene_options import split_cameras
from splatctrl_cli.config import ControlConfig, FieldConfig
from splatctrl_cli.control import qp
from splatctrl_cli.evaluate.field_accuracy import FIELDS, metric_scales
from splatctrl_cli.field import baker, distance, weights
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.grid_cells import exact_channel
from splatctrl_cli.formats.grid import grid_format, grid_formats
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_writer import SceneWriter
from splatctrl_cli.formats.splat.splats import FORMATS, write_ply
from splatctrl_cli.jobs.bake.accuracy import SUMMARY_METRICS
from splatctrl_cli.simulate.arm import UNMODELLED
from splatctrl_cli.simulate.truth import load_truth
from tests.cli.here import splatctrl
from tests.field.scenes import splat_set
from tests.jobs.stage import interrupt
from tests.plain import known, plain_grid

COARSE = ("--set", "field.max_loss=1")  # cells that are baked in no time


def test_bakes_both_formats_a_header_and_a_run(tmp_path: Path, splats: Path) -> None:
    out = tmp_path / "field"
    result = splatctrl(
        "sdf-bake", splats, "-o", out, "--json", "--voxel", 0.05, *COARSE, "--require", "num_cells>=1000"
    )
    assert (result.returncode, result.stderr.count("\n")) == (0, 1)
    assert sorted(path.name for path in out.iterdir()) == [
        *("field.json", "field.npz", "field.vti", "report", "run.json")
    ]
    assert sorted(path.name for path in (out / "report").iterdir()) == ["gradient.png", "slices.png"]
    grid, header = read_npz(out / "field.npz"), json.loads((out / "field.json").read_text())
    assert json.loads(result.stdout)["shape"] == list(grid.channels["sdf"].shape) == header["shape"]
    assert len(header["digests"]["splats.ply"]) == 64
    assert json.loads((out / "run.json").read_text())["config"]["field"]["voxel"] == 0.05


def test_a_failed_gate_keeps_the_output(tmp_path: Path, splats: Path) -> None:
    result = splatctrl(
        "sdf-bake", splats, "-o", tmp_path / "field", "--voxel", 0.1, *COARSE, "--require", "num_splats>1000000"
    )
    assert result.returncode == 1 and "num_splats is 600, required > 1e+06" in result.stdout
    assert (tmp_path / "field" / "field.npz").exists()


@pytest.mark.usefixtures("painted")
def test_a_field_of_splats_on_the_true_surface_is_within_the_allowance(tmp_path: Path, sample_data: Path) -> None:
    folder = sample_data / "tabletop"
    truth = load_truth(folder / "truth.json")
    box = np.array([[0.4, -0.15, -0.05], [0.7, 0.15, 0.2]])
    near = np.random.default_rng(0).uniform(box[0] - 0.25, box[1] + 0.25, (80_000, 3))
    distance, surface = truth.closest(near, int(truth.stamps[-1]))
    surface = surface[np.abs(distance) < 0.1]
    write_ply(tmp_path / "true.ply", splat_set(surface, np.full(len(surface), 0.002)), {})
    corners = ",".join(f"{value}" for value in box.ravel())
    trimesh.creation.box(bounds=box).export(tmp_path / "box.ply")
    result = splatctrl(
        "sdf-bake",
        tmp_path / "true.ply",
        *("-o", tmp_path / "field", f"--box={corners}", "--voxel", 0.03, *COARSE, "--formats", "npz"),
        *("--truth", folder / "truth.json", "--seen-by", folder / "log.mcap"),
        *("--held-out", f"{folder / 'log.mcap'}:cam3", "--reference-mesh", tmp_path / "box.ply"),
        *("--require", "over_estimate.count_beyond<=0", "--require", "seen.hard.0_2cm.rmse<0.006"),
    )
    assert result.returncode == 0, result.stderr
    accuracy = json.loads((tmp_path / "field" / "field.json").read_text())["accuracy"]["truth"]
    metrics = json.loads((tmp_path / "field" / "run.json").read_text())["metrics"]
    assert sorted(set(metrics) - {"devices"}) == sorted((*SUMMARY_METRICS, *metric_scales(FIELDS))), "as checked"
    assert accuracy["num_seen"] > 50 and accuracy["holds"] is True
    rows = [line.split()[:2] for line in result.stdout.splitlines() if line.startswith(("seen  ", "all   "))]
    assert rows == [[where, name] for where in ("seen", "all") for name in FIELDS for _ in range(4)]
    for text in (
        f"of {accuracy['num_seen']} seen cells",
        *("all: also those before backs that none saw", "probability, calibrated: calibration error"),
        *(f"--set field.error_mean={accuracy['error_mean']:.4f}", "held-out depth of 1 frames", "from mesh cm"),
    ):
        assert text in result.stdout
    assert [line.split()[:2] for line in result.stdout.splitlines() if "  on it " in line] == [
        [name, "on"] for name in ("sdf", "hard")
    ]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene folder whose splats move up 10 cm a second, and whose grid saw everything free at the end."""
    folder = tmp_path_factory.mktemp("scene")
    writer = SceneWriter(folder, {})
    start_ns, shape = 7_000_000_000, (4, 4, 4)
    at = [splat_set(np.array([[0.0, 0.0, 0.1 * second]]), np.array([0.01])) for second in range(3)]
    free = plain_grid(shape, 1.0, -1.5)
    for second, splats in enumerate(at):
        writer.snapshot(start_ns + second * 10**9, splats, known(free), np.full(shape, second, np.uint8))
    (folder / "snapshots" / "000000.npz").unlink()  # as in a scene of an older version
    writer.finish(start_ns + 2 * 10**9, at[-1], known(free))
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": start_ns + 2 * 10**9}
    (folder / "run.json").write_text(json.dumps({"metrics": metrics}))
    return folder


@pytest.mark.parametrize(("at", "height", "observed"), [(None, 0.2, 1), (0.0, 0.0, 0), (1.9, 0.1, 1), (2.0, 0.2, 2)])
def test_a_scene_is_baked_as_it_was_known_then(
    tmp_path: Path, scene: Path, at: float | None, height: float, observed: int
) -> None:
    times = [] if at is None else ["--at", at]
    box = "--box=-0.1,-0.1,-0.1,0.1,0.1,0.3"
    result = splatctrl("sdf-bake", scene, "-o", tmp_path / "field", box, "--voxel", 0.1, *COARSE, *times)
    assert result.returncode == 0, result.stderr
    grid = read_npz(tmp_path / "field" / "field.npz")
    assert exact_channel(grid)[1, 1, 4] == pytest.approx(0.3 - height - 0.01, abs=1e-6)
    assert (grid.channels["observed"] == observed).all()
    names = {None: "occupancy.npz", 0.0: "000000.ply", 1.9: "000001.npz", 2.0: "000002.npz"}
    assert [*grid.header["digests"]][-1] == names[at]


@pytest.mark.usefixtures("painted")
def test_a_box_that_no_camera_saw_is_not_evaluable(tmp_path: Path, scene: Path) -> None:
    result = splatctrl(
        "sdf-bake", scene, "-o", tmp_path / "field", "--box=7,7,7,8,8,8", "--voxel", 0.5, *COARSE, "--json"
    )
    verdict = json.loads(result.stdout)["verdict"]
    assert (result.returncode, verdict["outcome"]) == (5, "not evaluable")
    assert "no cell of the grid was ever seen by a camera; give a --box that the cameras saw" in result.stderr
    assert json.loads(result.stdout)["num_warnings"] == sum(reason["is_note"] for reason in verdict["reasons"])
    assert json.loads((tmp_path / "field" / "run.json").read_text())["verdict"] == verdict
    inside = splatctrl(
        "sdf-bake", scene, "-o", tmp_path / "seen", "--box=-0.1,-0.1,-0.1,0.1,0.1,0.3", "--voxel", 0.1, *COARSE
    )
    assert inside.returncode == 0
    assert inside.stdout.splitlines()[0] == "sdf-bake: PASSED (3 x 3 x 5 cells of 0.1 m, 1 splats)"


@pytest.mark.parametrize(
    ("names", "listed"),
    [
        (distance.KERNEL_OF, FieldConfig.declared["distance"].words),
        (weights.METHODS, FieldConfig.declared["weights"].words),
        (distance.PROBABILITIES, FieldConfig.declared["probability"].words),
        (qp.SOLVERS, ControlConfig.declared["solver"].words),
        (grid_formats.FORMATS, scene_options.GRID_FORMATS),
        (FORMATS, scene_options.SPLAT_FORMATS),
        (grid_format.CHANNELS, scene_options.CHANNELS),
        (baker.DEFAULT_CHANNELS, scene_options.CHANNELS[:4]),
        (UNMODELLED, run_options.UNMODELLED),
    ],
)
def test_the_names_that_the_options_list_are_those_of_the_rooms(
    names: Iterable[str], listed: tuple[str, ...]
) -> None:
    assert tuple(names) == listed


def test_options_and_configuration_say_the_same(tmp_path: Path, splats: Path) -> None:
    options = ["--distance", "safe_gpdf", "--weights", "voxel", "--length-scale", 0.03, "--unknown", "free"]
    keys = ["distance=safe_gpdf", "weights=voxel", "length_scale=0.03", "unknown=free"]
    settings = [part for key in keys for part in ("--set", f"field.{key}")]
    same = ["--box=-0.2,-0.2,-0.2,0.2,0.2,0.2", "--voxel", 0.05, *COARSE, "--no-report"]
    for name, given in (("a", options), ("b", settings)):
        assert splatctrl("sdf-bake", splats, "-o", tmp_path / name, *same, *given).returncode == 0
    first, second = ((tmp_path / name / "field.npz").read_bytes() for name in "ab")
    assert first == second


@pytest.mark.parametrize(
    ("text", "path", "cameras"),
    [
        ("log.mcap", "log.mcap", ()),
        ("log.mcap:cam0, cam1", "log.mcap", ("cam0", "cam1")),
        ("a:b.mcap", "a:b.mcap", ()),
    ],
)
def test_cameras_that_were_held_out_follow_the_log(
    tmp_path: Path, text: str, path: str, cameras: tuple[str, ...]
) -> None:
    (tmp_path / "a:b.mcap").touch()
    assert split_cameras(str(tmp_path / text)) == (tmp_path / path, cameras)


def test_the_field_that_is_updated_is_not_replaced(tmp_path: Path, splats: Path) -> None:
    field = tmp_path / "field"
    given = ["sdf-bake", splats, "-o", field, "--voxel", 0.1, *COARSE, "--formats", "npz", "--no-report"]
    assert splatctrl(*given).returncode == 0
    again = splatctrl(*given, "--update", field, "--force")
    assert again.returncode == 2 and "would replace the input" in again.stderr
    updated = splatctrl(*given, "--update", field, "-o", tmp_path / "same")
    assert updated.returncode == 0 and "blocks baked" in updated.stdout
    assert (tmp_path / "same" / "field.npz").read_bytes() == (field / "field.npz").read_bytes()


def test_resume_goes_on_with_what_is_left(tmp_path: Path, splats: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = ["sdf-bake", splats, "-o", tmp_path / "field", "--voxel", 0.1, *COARSE, "--formats", "npz"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("splatctrl_cli.field.slabs.label_counts", interrupt)
        stopped = splatctrl(*given)
    assert stopped.returncode == 130
    assert f"field.partial is kept; continue it with: splatctrl sdf-bake --resume {splats} " in stopped.stderr
    monkeypatch.setattr(Baker, "bake", None)  # nothing is left to bake
    resumed = splatctrl(*given, "--resume")
    assert resumed.returncode == 0 and "continues after" in resumed.stderr
