"""A shell is rendered, and nothing that judges or bakes meets it: a scene answers as if it had none."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.files.output import part_digests
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.formats.splat.splats import SHELL, read_ply, write_ply
from splatctrl_cli.jobs.export.export import ExportRequest, export
from splatctrl_cli.jobs.query.query import QueryRequest, query
from splatctrl_cli.jobs.report.spaces import space_of_scene
from splatctrl_cli.records import SplatSet
from tests.cli.replay_desk import splats_of
from tests.jobs.bake.baked import baked
from tests.jobs.score.test_score import run as scores
from tests.jobs.score.wall import FRAMES, FakeScene, FakeSource, set_up, wall, write_scene
from tests.jobs.stage import Stage, ball_beside, patch_json, voxels
from tests.refused import expect_refusal


def with_shell(scene: Path, shell: SplatSet) -> Path:
    """The scene, to which a shell of these splats was written, at each of its times."""
    for path in (scene / "shell.ply", *(s.shell_path for s in open_scene(scene).snapshots)):
        write_ply(path, shell, SHELL)
    patch_json(scene / "run.json", lambda run: run | {"parts": part_digests(scene)})
    return scene


def in_the_way(stage: Stage) -> SplatSet:
    """A ball into which the arm moves, and a wall around: where a robot of a longer reach would meet them."""
    ball = ball_beside(stage.arm, stage.states[-1].position, -0.03)
    return splats_of(ball, *(((x, y, 0.5), 0.3) for x in (-2.0, 2.0) for y in np.arange(-2.0, 2.0, 0.4)))


@pytest.mark.parametrize(("mode", "is_known"), [("audit", False), ("open-loop", True), ("closed-loop", True)])
def test_a_shell_in_the_arms_way_changes_no_verdict_and_no_step(stage: Stage, mode: str, is_known: bool) -> None:
    stage.last_seen = None if is_known else voxels(is_known=False)
    bare = stage.judged(mode=mode, scene=stage.scene("bare"))
    steps = stage.desk.rows()
    given = stage.judged(mode=mode, scene=with_shell(stage.scene("given"), in_the_way(stage)))
    assert given == bare and steps == stage.desk.rows()
    assert bare[1]["label"] == ("safe" if is_known else bare[1]["label"]) and (bare[0] == 0) == is_known


@pytest.mark.parametrize("at", [None, 0.3])
def test_fields_and_answers_have_the_same_bytes_with_a_shell(stage: Stage, tmp_path: Path, at: float | None) -> None:
    shell, found = in_the_way(stage), []
    points = "x,y,z\n" + "".join(f"{x},{y},{z}\n" for x, y, z in [*shell.centers, *np.eye(3)])
    for scene in (stage.scene("bare"), with_shell(stage.scene("given"), shell)):
        field, answers = tmp_path / f"field_{scene.name}", tmp_path / f"{scene.name}.csv"
        baked(scene, field, voxel=0.1, at=at)
        query(QueryRequest(source=scene, points=io.StringIO(points), out=answers, at=at))
        found.append(((field / "field.npz").read_bytes(), answers.read_text()))
    assert found[0] == found[1]
    rows = [*csv.DictReader(io.StringIO(found[1][1]))]
    assert float(rows[0]["distance"]) > 0.1 and rows[1]["observed"] == "never_seen"


def test_an_export_and_a_picture_of_spheres_leave_the_shell_out(stage: Stage) -> None:
    scene = with_shell(stage.scene(), in_the_way(stage))
    export(ExportRequest(scene=scene, out=scene.parent / "all.ply"))
    assert len(read_ply(scene.parent / "all.ply")[0]) == len(open_scene(scene).splats()) == 1
    assert len(space_of_scene(open_scene(scene)).splats[0]) == 1


@pytest.mark.parametrize(
    "words",
    [
        ["query", "-", "points.csv"],
        *(["sdf-bake", "-"], ["replay", "fake.mcap", "--scene", "-"]),
        *(["export", "-", "-o", f"out{suffix}"] for suffix in (".ply", ".splat", ".spz")),
        ["score", "-", "--reference", "fake.mcap"],
    ],
    ids=lambda words: words[0],
)
def test_a_shell_alone_is_refused_wherever_splats_are_taken(
    stage: Stage, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = with_shell(stage.scene(), in_the_way(stage))
    monkeypatch.chdir(stage.desk.folder)
    Path("points.csv").write_text("x,y,z\n0,0,0\n")
    given = [str(scene / "shell.ply") if word == "-" else word for word in words]
    robot = stage.desk.robot if words[0] == "replay" else []
    assert main([*given, *robot]) in (2, 4)
    said = capsys.readouterr().err
    assert "splats.ply" in said or "reconstruct wrote" in said


def test_other_splats_in_the_place_of_a_shell_are_refused(stage: Stage) -> None:
    """As a changed or missing file is, by its digest."""
    scene = stage.scene()
    times = (None, open_scene(scene).snapshots[-1].stamp_ns)
    assert [open_scene(scene).shell_at(time) for time in times] == [None, None]
    with_shell(scene, in_the_way(stage))
    assert all(open_scene(scene).shell_at(time) is not None for time in times)
    (scene / "shell.ply").write_bytes((scene / "splats.ply").read_bytes())
    expect_refusal(r"shell.ply: was changed after it was written", open_scene(scene).shell_at, None)
    patch_json(scene / "run.json", lambda run: run | {"parts": part_digests(scene)})
    expect_refusal("expected a shell, got other splats", open_scene(scene).shell_at, None)
    assert len(open_scene(scene).splats()) == 1


def test_a_score_shows_the_shell_and_keeps_its_depth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the wall is the map, the other half the shell."""
    is_left = wall().centers[:, 1] > 0.0
    views: dict[bool, dict[str, Any]] = {}

    class Half(FakeScene):
        def splats_at(self, stamp_ns: int) -> SplatSet:
            return wall().select(is_left)

        def shell_at(self, stamp_ns: int | None) -> SplatSet | None:
            return wall().select(~is_left) if has_shell else None

    write_scene(tmp_path, monkeypatch)
    set_up(monkeypatch, Half(), FakeSource(frames=FRAMES))
    for has_shell in (False, True):
        views[has_shell] = scores(tmp_path).document["views"][1]
    assert views[True]["psnr_all"] > views[False]["psnr_all"] + 20
    kept = ("depth_median_all", "depth_coverage_all", "depth_pixels_all", "in_front_all", "seen_share")
    assert [views[True][name] for name in kept] == [views[False][name] for name in kept]


@pytest.mark.usefixtures("unchecked")
def test_a_recording_with_a_robot_has_a_shell_and_counts_it_apart(small_recording: Path, tmp_path: Path) -> None:
    fast = ["--max-splats", "400", "--set", "scene.first_iterations=20", "--set", "scene.iterations_per_step=4", "-q"]
    log = [str(small_recording / "log.mcap"), "--cameras", "cam1,cam2", *fast]
    robot = ["--urdf", str(small_recording / "robot.urdf"), "--spheres", str(small_recording / "robot_spheres.yaml")]
    found = {}
    for name, more in (("with", robot), ("without", [*robot, "--set", "scene.shell=0"])):
        assert main(["reconstruct", *log, *more, "-o", str(tmp_path / name)]) == 0
        scene = open_scene(tmp_path / name)
        metrics, shell = json.loads((tmp_path / name / "run.json").read_text())["metrics"], scene.shell_at(None)
        assert metrics["splats"] == len(scene.splats()) <= 400
        assert metrics["shell_splats"] == (0 if shell is None else len(shell))
        assert (0 < metrics["shell_splats"] <= 40) == (name == "with")
        kept = ("splats.ply", "occupancy.npz", "audit.jsonl", "snapshots.csv", *(s.path for s in scene.snapshots))
        found[name] = [(scene.path / file).read_bytes() for file in kept]
        assert all((s.shell_path.is_file()) == (name == "with") for s in scene.snapshots)
    assert found["with"] == found["without"]
