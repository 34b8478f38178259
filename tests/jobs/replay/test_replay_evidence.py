"""A scene, field, truth and log that do not belong together never come to a green verdict."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.files.output import part_digests
from splatctrl_cli.formats.grid.npz_grid import read_npz, write_npz
from splatctrl_cli.formats.splat.splats import read_ply, write_ply
from splatctrl_cli.records import SplatSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import VoxelState
from tests.cli.replay_desk import SECOND, START, Desk, grid_seen, splats_of
from tests.jobs.stage import FAR, Stage, decisive, patch_json, states_on
from tests.plain import known
from tests.recording.log.make_states import states_of, write_mcap


@pytest.fixture
def stage(desk: Desk, arm: RobotModel) -> Stage:
    """Whose map is a plate of splats on occupied voxels, behind the arm."""
    cells = np.array([[4, j, 20 + k] for j in range(10, 16) for k in range(4)])
    voxels = known(grid_seen())
    voxels.grid.log_odds[tuple(cells.T)] = 4.0
    centers = voxels.grid.origin + voxels.grid.voxel * cells
    balls = [((float(x), float(y), float(z)), 0.05) for x, y, z in centers]
    assert voxels.grid.states(0.3, 0.7)[4, 10, 20] == VoxelState.OCCUPIED
    return Stage(desk=desk, arm=arm, balls=balls, last_seen=voxels)


def of_run(scene: Path, **changes: Any) -> None:
    """The scene's run.json with changes of metrics, inputs or parts."""
    metrics = changes.pop("metrics", {})
    patch_json(scene / "run.json", lambda run: run | {"metrics": run["metrics"] | metrics} | changes)


def splats_changed(scene: Path, change: Callable[[SplatSet], SplatSet], **comments: str) -> None:
    """The final splats and those of every snapshot, changed, with digests that fit."""
    for file in (scene / "splats.ply", *sorted((scene / "snapshots").glob("*.ply"))):
        splats, said = read_ply(file)
        write_ply(file, change(splats), {**said, **comments})
    of_run(scene, parts=part_digests(scene))


def moved(splats: SplatSet, scale: float = 1.0, by: float = 0.0) -> SplatSet:
    return replace(
        splats,
        centers=(scale * splats.centers + by).astype(np.float32),
        radii=(scale * splats.radii).astype(np.float32),
    )


def rows_of(scene: Path, step: int | None) -> None:
    """The table of snapshots with its rows in steps of 1 or -1, or without a row."""
    header, *rows = (scene / "snapshots.csv").read_text().splitlines()
    (scene / "snapshots.csv").write_text("\n".join([header, *(rows[::step] if step else [])]) + "\n")


def rows_with_digests(scene: Path, step: int | None) -> None:
    rows_of(scene, step)
    of_run(scene, parts=part_digests(scene))


def test_a_scene_that_belongs_to_its_log_is_safe(stage: Stage) -> None:
    assert stage.judged()[0] == 0


JOINTS = [f"joint{number}" for number in range(1, 8)]
ON_A_STAND = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1]]
NOT_ITS_OWN: dict[str, tuple[Callable[[Path], None], str]] = {
    "other digests": (lambda s: of_run(s, inputs={"fake.mcap": "1" * 64}), "was made from another recording"),
    "another robot": (
        lambda s: of_run(s, metrics={"robot_joints": list("abcdefg")}),
        "another robot, with joints a, b",
    ),
    "a table among the robot's links": (
        lambda s: of_run(s, metrics={"robot_joints": JOINTS, "robot_links": {"cell": [0, 0, 0, 1, 1, 1, 6]}}),
        "another robot, with link cell, which this one does not have",
    ),
    "a robot on a stand": (
        lambda s: of_run(s, metrics={"robot_joints": JOINTS, "robot_base": ON_A_STAND}),
        "another robot, its root at (0.000, 0.000, 0.800) m or turned otherwise: give that place with --base",
    ),
    "depth that no sensor measured": (
        lambda s: of_run(s, metrics={"depth_bend": 0.02}),
        "depth corrected by up to 2.0 %",
    ),
    "robot of an earlier version": (lambda s: of_run(s, metrics={"robot_joints": JOINTS}), "stored the joints alone"),
    "with a calibration": (
        lambda s: of_run(s, inputs={"--calibration cell.toml": "1" * 64}),
        "was made with cell.toml, this log is read without one",
    ),
    "with errors of its frames": (
        lambda s: of_run(s, inputs={"--perturb pose-error=0.01": "pose-error=0.01"}),
        "was made with --perturb pose-error=0.01, this log is read without one",
    ),
    "no digests": (
        lambda s: patch_json(s / "run.json", lambda run: {name: run[name] for name in run if name != "parts"}),
        "an earlier version wrote it",
    ),
    "millimetres": (lambda s: splats_changed(s, lambda splats: moved(splats, 1e3)), "splats and occupancy disagree"),
    "moved by 3 m": (
        lambda s: splats_changed(s, lambda splats: moved(splats, by=-3)),
        "splats and occupancy disagree",
    ),
    "one splat left": (
        lambda s: splats_changed(s, lambda splats: splats.select(np.arange(len(splats)) == 0)),
        "of 24 occupied voxels are represented",
    ),
    "no snapshot left": (lambda s: rows_with_digests(s, None), "got only the map of its end"),
}


@pytest.mark.parametrize("name", NOT_ITS_OWN)
def test_evidence_of_something_else_is_not_evaluable(stage: Stage, name: str) -> None:
    change, words = NOT_ITS_OWN[name]
    scene = stage.scene()
    change(scene)
    stage.expect(5, {"evidence": "not evaluable"}, scene=scene, says=words)


REFUSED: dict[str, tuple[Callable[[Path], None], str]] = {
    "snapshots emptied": (lambda s: rows_of(s, None), "snapshots.csv: was changed after it was written"),
    "snapshots reversed": (lambda s: rows_of(s, -1), "snapshots.csv: was changed after it was written"),
    "reversed, with digests that fit": (
        lambda s: rows_with_digests(s, -1),
        "expected stamps that ascend",
    ),
    "splats altered": (
        lambda s: write_ply(s / "splats.ply", splats_of(FAR), {"frame": "world"}),
        "splats.ply: was changed after it was written",
    ),
    "units: mm": (lambda s: splats_changed(s, lambda splats: splats, units="mm"), "comment 'units: mm'"),
    "frame: camera_link": (
        lambda s: splats_changed(s, lambda splats: splats, frame="camera_link"),
        "comment 'frame: camera_link'",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_parts_that_were_changed_are_refused_by_name(
    stage: Stage, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    change, words = REFUSED[name]
    scene = stage.scene()
    change(scene)
    assert stage.judged(scene=scene) == (4, {}) and words in capsys.readouterr().err
    assert not list(stage.desk.folder.glob("out*"))


def baked(stage: Stage, scene: Path) -> Path:
    """A field of the scene; the log has the stage's states."""
    field = stage.desk.folder / "field"
    box = ["--box=-1.2,-1,0,1,1,1.4", "--voxel", "0.08", "--no-report", "--set", "field.max_loss=1"]
    assert main(["sdf-bake", str(scene), "-o", str(field), *box, "-q"]) == 0
    stage.desk.source.states = stage.states
    return field


@pytest.mark.parametrize("links", [{}, {"cell": [0, 0, 0, 1, 1, 1, 6]}])
def test_a_field_knows_the_robot_that_its_scene_was_told_apart_from(
    stage: Stage, links: dict[str, list[float]]
) -> None:
    scene = stage.scene()
    of_run(scene, metrics={"robot_joints": JOINTS, "robot_links": links})
    _, verdict = stage.replayed("--field", str(baked(stage, scene)))
    said = [reason["sentence"] for reason in verdict["reasons"] if reason["criterion"] == "evidence"]
    words = "another robot, with link cell, which this one does not have"
    assert [words in text for text in said] == [True] * len(links)


def test_an_altered_field_is_refused(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    field = baked(stage, stage.scene())
    grid = read_npz(field / "field.npz")
    bound = {name: values + np.float32(1.0) for name, values in grid.channels.items() if "bound" in name}
    write_npz(field / "field.npz", replace(grid, channels=grid.channels | bound))
    assert stage.replayed("--field", str(field)) == (4, {})
    assert "field.npz: was changed after it was written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("off", "late_ns", "code", "words"),
    [
        ([0, 0, 0, -0.05] + [0] * 7, 0, 4, "is of another recording: its clearances differ by up to 50 mm from"),
        ([0] * 11, 7, 4, "the log has none of its 11 stamps"),
        ([5e-4] * 11, 0, 0, ""),
    ],
    ids=["other clearances", "other stamps", "rounded"],
)
def test_a_truth_of_another_recording_is_refused_and_a_rounded_one_is_not(
    stage: Stage, capsys: pytest.CaptureFixture[str], off: list[float], late_ns: int, code: int, words: str
) -> None:
    truth = stage.truth(FAR)
    true = json.loads(truth.read_text())["clearance"]
    distances = [value + more for value, more in zip(true["distance"], off, strict=True)]
    changed = true | {"distance": distances, "stamps": [stamp + late_ns for stamp in true["stamps"]]}
    patch_json(truth, lambda document: document | {"clearance": changed})
    assert stage.judged("--truth", str(truth))[0] == code
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(("away_s", "is_other"), [(0.9, False), (1.1, True)])
def test_times_of_scene_and_states_may_be_a_second_apart(stage: Stage, away_s: float, is_other: bool) -> None:
    stage.states = states_on(np.tile(START, (3, 1)), start_ns=int(stage.map_stamps[-1] + away_s * SECOND))
    _, verdict = stage.judged("--max-map-age", "10")
    assert decisive(verdict).get("evidence") == ("not evaluable" if is_other else None)
    assert not is_other or "are of different times" in str(verdict["reasons"])


@pytest.mark.parametrize("per_stamp", [50, 2])
def test_states_that_share_stamps_are_missed_not_dropped_in_silence(stage: Stage, per_stamp: int) -> None:
    """Stamps in whole seconds, or in pairs."""
    positions = START + np.linspace(0, 1, 101)[:, None] * np.array([0.5, 0, 0, 0, 0, 0, 0])
    stamps = [SECOND + (i // per_stamp) * per_stamp * SECOND // 50 for i in range(101)]
    stage.map_stamps = [SECOND + i * SECOND // 4 for i in range(9)]
    log = write_mcap(stage.desk.folder / "x.mcap", states_of(positions, tuple(JOINTS), stamps=stamps))
    out, scene = ("-o", str(stage.desk.folder / "out")), ("--scene", str(stage.scene()))
    assert main(["replay", str(log), *stage.desk.robot, *scene, *out, "-q"]) == 5
    (dropped,) = (r for r in stage.desk.verdict()["reasons"] if r["criterion"] == "judged states")
    assert (dropped["outcome"], dropped["value"]) == ("not evaluable", len(stamps) - len(set(stamps)))
