"""Reports and pages in 3-D of runs, scenes, fields and batches; opened in a browser where there is one."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.cli import report as command
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import UsageError
from splatctrl_cli.files.output import part_digests
from splatctrl_cli.geometry import look_at, transform_from
from splatctrl_cli.jobs.compare.compare import CompareRequest, compare
from splatctrl_cli.jobs.report.report import MOST_SCENES, ViewRequest, WriteReportRequest, view, write_report
from splatctrl_cli.jobs.report.spaces import space_of, space_of_scene
from splatctrl_cli.jobs.runs.run_folder import States, open_run
from splatctrl_cli.report.page import pack
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import SeenVoxels, Unseen
from tests.jobs.stage import Runs, Stage, passing, patch_json
from tests.plain import plain_splats
from tests.refused import expect_refusal
from tests.report.browser import found_on

ARM = "const arm = () => viewer.links.map((link) => link.position.toArray().concat(link.quaternion.toArray()));"
OPENED = "let viewer; while (!(viewer = document.querySelector('.space')?.viewer)) await wait(50);"


def reported(path: Path, **more: Any) -> str:
    out = path.with_name("page.html")
    write_report(WriteReportRequest(path=path, out=out, force=True, **more))
    return out.read_text()


def shown(path: Path, script: str) -> dict[str, Any]:
    """Run a script on the page of a run or batch without errors, and return its results."""
    reported(path)
    found = found_on(path.with_name("page.html"), f"{OPENED} {script}" if "while" not in script else script)
    assert found.pop("complaints") == []
    return found


def test_a_report_says_the_verdict_first_and_holds_everything_itself(run: Runs) -> None:
    folder = run()
    page, run_json = reported(folder), json.loads((folder / "run.json").read_text())
    sentence, body = run_json["verdict"]["sentence"], page[page.index("<body>") :]
    assert body.index(sentence.split(":")[0]) < body.index("<table") < body.index('<svg class="timeline"')
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page) and len(page) < 2_000_000
    assert "MARGIN BROKEN" in sentence
    assert all(words in page for words in ("data:image/jpeg;base64,", "replay fake.mcap --scene scene"))


def test_the_scene_of_a_replay_is_the_one_known_at_each_time(run: Runs, arm: RobotModel) -> None:
    space = space_of(run())
    num_splats = {seconds: len(splats) for seconds, splats in space.splats.items()}
    assert num_splats == {0.0: 1, 0.25: 1, 0.5: 2, 0.75: 2, 1.0: 2}
    worst = int(np.argmin(space.motion.clearance))
    np.testing.assert_allclose(space.motion.path[worst], arm.frame_pose(passing()[worst].position, "hand")[:3, 3])
    gap = np.linalg.norm(np.subtract(space.deciding["center"], space.deciding["place"])) - space.deciding["radius"]
    assert gap == pytest.approx(0.012, abs=1e-4)


def test_a_scene_opens_at_its_first_camera_and_has_a_menu_of_all(stage: Stage, tmp_path: Path) -> None:
    eyes = {"front": [0.0, 0.0, 0.5], "side": [-1.0, 1.0, 1.5]}
    frames = [
        {
            "camera": name,
            "intrinsics": [40.0, 24.0, 31.5, 23.5, 64.0, 48.0],
            "T_world_camera": look_at(eye, [-1.0, 0.0, 1.3]).ravel().tolist(),
        }
        for name, eye in eyes.items()
    ]
    scene = replace(stage, metrics={"cameras": [*eyes], "stamp_ns": 0, "first_frames": frames}).scene()
    side = space_of(scene).cameras[1]
    assert (side["name"], side["eye"], side["fov"]) == ("side", eyes["side"], pytest.approx(90.0))
    np.testing.assert_allclose(side["ahead"], np.array([0.0, -1.0, -0.2]) / np.hypot(1.0, 0.2))
    page = view(ViewRequest(path=scene, out=tmp_path / "page.html")).out
    script = f"""{OPENED} const place = () => {{ viewer.paint(); return viewer.camera.position.toArray(); }};
      const menu = document.querySelector("select"); found.names = [...menu.options].map((one) => one.textContent);
      found.front = place(); menu.value = 1; menu.onchange(); found.side = place(); found.fov = viewer.camera.fov;
      found.ahead = viewer.target.clone().sub(viewer.camera.position).normalize().toArray();"""
    found = found_on(page, script)
    assert (found["complaints"], found["names"]) == ([], ["view from", "front", "side"])
    np.testing.assert_allclose([found["front"], found["side"]], [*eyes.values()], atol=1e-6)
    np.testing.assert_allclose([*found["ahead"], found["fov"]], [*side["ahead"], 90.0], atol=1e-6)


def test_the_slider_moves_the_arm_and_shows_what_was_known_then(run: Runs) -> None:
    folder = run()
    script = f"""{ARM}
      viewer.slider.value = 0; viewer.slider.oninput(); found.first = arm();
      const shown = () => viewer.sets.map((set) => set.nodes[0].visible);
      found.early = shown();
      viewer.slider.value = viewer.slider.max; viewer.slider.oninput(); found.last = arm();
      found.late = shown(); found.words = viewer.words.textContent;
      await wait(300); const pixels = new Uint8Array(4 * 90000), gl = viewer.renderer.getContext(); viewer.paint();
      gl.readPixels(0, 0, 300, 300, gl.RGBA, gl.UNSIGNED_BYTE, pixels); found.shades = new Set(pixels).size;"""
    found, motion = shown(folder, script), space_of(folder).motion
    for name, poses in (("first", motion.poses[0]), ("last", motion.poses[-1])):
        drawn = [transform_from(link[:3], link[3:]) for link in found[name]]
        np.testing.assert_allclose(drawn, poses, atol=2e-4)
    assert np.abs(np.array(found["first"])[:, :3] - np.array(found["last"])[:, :3]).max() > 0.05
    assert (found["early"], found["late"]) == ([True, *4 * [False]], [*4 * [False], True])
    assert found["words"].startswith("1.00 s, ") and found["shades"] > 10


def test_a_click_in_the_timeline_moves_the_arm_and_the_pointer_reads_values(run: Runs) -> None:
    folder = run(mode="closed-loop")
    assert "QP rung" in reported(folder)
    script = """
      const line = document.querySelector(".timeline"), box = line.getBoundingClientRect();
      const at = {clientX: box.left + 0.5 * box.width, clientY: box.top + 50, bubbles: true};
      line.dispatchEvent(new MouseEvent("click", at));
      found.state = +viewer.slider.value; found.most = +viewer.slider.max;
      line.dispatchEvent(new PointerEvent("pointermove", at));
      found.words = line.parentElement.querySelector(".hover").textContent;"""
    found = shown(folder, script)
    assert 0.3 < found["state"] / found["most"] < 0.7
    assert re.fullmatch(
        r"\d+\.\d\d s; to the splats -?[\d.]+ mm; by the controller's field -?[\d.]+ mm", found["words"]
    )


def test_a_moved_scene_is_found_below_root_and_a_changed_robot_is_refused(run: Runs, tmp_path: Path) -> None:
    folder = run()
    (tmp_path / "away").mkdir()
    (tmp_path / "scene").rename(tmp_path / "away" / "scene")
    assert "the scene scene of its command line is not found" in reported(folder)
    assert 'data-scene="data-scene"' in reported(folder, roots=(tmp_path / "away",))
    patch_json(folder / "run.json", lambda found: found | {"inputs": {**found["inputs"], "robot.urdf": "0" * 64}})
    assert "is not found, or was changed since" in reported(folder, roots=(tmp_path / "away",))


def test_texts_of_a_run_are_no_markup(run: Runs) -> None:
    folder = run()
    bad = "</script><script>alert(1)</script>"
    patch_json(folder / "run.json", lambda f: f | {"verdict": {**f["verdict"], "sentence": bad}, "seed": bad})
    patch_json(folder / "events.json", lambda f: {"events": [{**event, "kind": bad} for event in f["events"]]})
    patch_json(folder / "run.json", lambda found: found | {"parts": part_digests(folder)})
    assert "alert(1)</script>" not in reported(folder)


@pytest.mark.parametrize(
    ("break_it", "words"),
    [
        (lambda path: path.rename(path.with_name("audit.partial")), "still writing, or was interrupted"),
        (lambda path: (path / "run.json").unlink(), "got a folder without run.json"),
        (lambda path: (path / "run.json").write_text("[]"), "expected what a command of splatctrl writes"),
        (
            lambda path: patch_json(path / "run.json", lambda f: f | {"splatctrl": "99.1"}),
            "written by splatctrl 99.1",
        ),
        (lambda path: (path / "steps.csv").write_text("time_s\n0\n"), "was changed after it was written"),
    ],
)
def test_what_is_no_whole_run_is_refused(run: Runs, break_it: Callable[[Path], None], words: str) -> None:
    folder = run()
    break_it(folder)
    expect_refusal(words, write_report, WriteReportRequest(path=folder))
    assert not folder.with_name("audit.html").exists()


def test_a_report_is_not_replaced_without_force_and_a_run_without_anything_to_see_is_refused(run: Runs) -> None:
    folder = run()
    assert write_report(WriteReportRequest(path=folder)).out == folder.with_name("audit.html")
    expect_refusal("already exists", write_report, WriteReportRequest(path=folder), error=UsageError)
    patch_json(folder / "run.json", lambda found: found | {"command": "score"})
    expect_refusal("score leaves nothing to see", view, ViewRequest(path=folder))


@pytest.fixture
def batch(run: Runs, tmp_path: Path) -> Path:
    """Ten recordings with an audit each, of which the third is not as expected, and the fourth has an error."""
    folder, audit = tmp_path / "batch", run()
    verdict = json.loads((audit / "run.json").read_text())["verdict"]
    judged = {key: verdict[key] for key in ("outcome", "label", "sentence", "exit_code")}
    ends = {
        2: judged | {"state": "failed", "expect": "passed"},
        3: {"state": "error", "cause": "timed out after 600 s"},
    }
    nodes = []
    for number in range(10):
        out = f"rec{number}/audit"
        (folder / out).parent.mkdir(parents=True)
        (folder / f"{out}.log").write_text(f"a line of {number}\n")
        node = {"id": out, "recording": f"rec{number}", "job": "audit", "command": "replay", "new": "later"}
        node |= {"out": out, "log": f"{out}.log", "result": f"{out}.json", "expect": "failed"}
        nodes.append(node | ends.get(number, judged | {"state": "done"}))
        if number != 3:
            shutil.copytree(audit, folder / out)
    document = {"format": "splatctrl-batch", "version": 1, "suite": "desk", "jobs": ["audit"], "nodes": nodes}
    (folder / "batch.json").write_text(json.dumps(document))
    return folder


@pytest.fixture
def before(batch: Path, tmp_path: Path) -> Path:
    """The batch as it was before the seventh replay came nearer, and the eighth kept further off."""
    shutil.copytree(batch, tmp_path / "before")
    for number, clearance in ((7, -0.9), (8, 0.9)):
        path, metrics = batch / f"rec{number}/audit/run.json", {"min_clearance": clearance}
        patch_json(path, lambda run, new=metrics: run | {"metrics": run["metrics"] | new})
    return tmp_path / "before"


def test_a_batch_begins_with_what_is_not_as_expected(batch: Path, before: Path) -> None:
    page = reported(batch, against=before)
    sections, scenes = re.findall(r'<section id="([^"]+)"', page), r'data-scene="'
    assert (sections[:3], len(sections)) == (["rec2/audit", "rec3/audit", "rec7/audit"], 10)
    first = "2 of 10 jobs not as expected; first rec2/audit: replay: MARGIN BROKEN"
    assert all(words in page for words in (first, "timed out after 600 s", "a line of 3"))
    assert page.count("The value of each curve") == 1 and len(re.findall(scenes, page)) == MOST_SCENES
    assert len(re.findall(scenes, reported(batch, all_scenes=True))) == 9


def test_a_scene_of_a_batch_opens_when_it_is_asked_for_and_closes_the_other(batch: Path) -> None:
    script = """const buttons = [...document.querySelectorAll("button.open")];
      const spaces = [...document.querySelectorAll(".space")];
      for (const k of [0, 1]) { buttons[k].click(); while (!spaces[k].viewer) await wait(50); }
      found.canvases = spaces.map((space) => space.querySelectorAll("canvas").length);"""
    assert shown(batch, script) == {"canvases": [0, 1, 0, 0, 0, 0]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version 2, this program reads 1"),
        ({"format": "other"}, "not what a batch writes"),
        ({"nodes": [3]}, "nodes"),
    ],
)
def test_a_batch_of_another_form_is_refused(batch: Path, change: dict[str, Any], words: str) -> None:
    patch_json(batch / "batch.json", lambda found: found | change)
    expect_refusal(words, write_report, WriteReportRequest(path=batch))


def test_a_job_that_leads_out_of_its_batch_is_not_read(batch: Path) -> None:
    patch_json(batch / "batch.json", lambda f: f | {"nodes": [{**node, "out": "../audit"} for node in f["nodes"]]})
    assert "expected a path in the batch" in reported(batch)


def test_a_report_says_what_changed_since_a_batch_or_a_baseline(batch: Path, before: Path, tmp_path: Path) -> None:
    for folder in (batch, before):  # as few recordings as are judged one by one
        patch_json(folder / "batch.json", lambda f: f | {"nodes": [f["nodes"][k] for k in (2, 7, 8)]})
    as_expected = {"failed": "done"}
    patch_json(
        batch / "batch.json",
        lambda f: (
            f | {"nodes": [node | {"state": as_expected.get(node["state"], node["state"])} for node in f["nodes"]]}
        ),
    )
    page = reported(batch, against=before)
    table, better = page[page.index("What changed") : page.index("<h2>Recordings")].split("<details>")
    assert re.findall(r'href="#([^"]+)"', table) == ["rec2/audit", "rec7/audit"]
    assert "compare: REGRESSION" in table and "min_clearance" in table and "state " in table
    assert re.findall(r'href="#([^"]+)"', better) == ["rec8/audit"]
    compare(CompareRequest(runs=(before,), update_baseline=tmp_path / "baseline.toml"))
    against = reported(batch, against=tmp_path / "baseline.toml")
    assert re.findall(r'<tr class="failed">.*', against) == re.findall(r'<tr class="failed">.*', page)


def test_a_report_says_that_nothing_changed(run: Runs) -> None:
    folder = run()
    (changed,) = reported(folder, against=folder).split("<h2>What changed")[1:]
    assert "NO REGRESSION" in changed[:200]


def added(batch: Path, *nodes: dict[str, Any]) -> str:
    """The page of a batch with these nodes, too, which are named by recording and job."""
    parts = [node["id"].split("/") for node in nodes]
    names = [{"recording": recording, "job": job.partition("+")[0]} for recording, job in parts]
    more = [name | node for name, node in zip(names, nodes, strict=True)]
    patch_json(batch / "batch.json", lambda found: found | {"nodes": [*found["nodes"], *more]})
    return reported(batch)


def test_variants_have_a_column_each_and_what_only_prints_has_no_folder_to_miss(batch: Path) -> None:
    skipped = {"state": "skipped", "cause": "needs it"}
    check = {"command": "check", "state": "failed", "out": "", "outcome": "passed", "label": "passed"}
    drives = [{"id": f"rec0/drive+rate={rate}", **skipped} for rate in (1, 2)]
    page = added(batch, *drives, {"id": "rec0/check", "expect": "failed", **check})
    assert re.findall(r"<th[^>]*>(drive[^<]*)<", page) == ["drive +rate=1", "drive +rate=2"]
    assert "expected a path in the batch" not in page


def test_many_recordings_are_folded_and_an_expected_error_is_said(batch: Path) -> None:
    refused = {"command": "ingest", "state": "done", "label": "exit 4", "expect": "exit 4"}
    more = [{"id": f"bag{k}/ingest", **refused} for k in range(50)]
    page = added(batch, *more, {"id": "bag0/scene", "state": "skipped", "cause": "needs it"})
    first, _, rest = page[page.index("<h2>Recordings") :].partition("<summary>20 more recordings</summary>")
    assert (first.count("<tr"), rest.count(">exit 4, as expected<")) == (41, 20)
    found = [words in page for words in ("bag0/scene", 'id="bag0/scene"', 'href="#bag0/scene"')]
    assert found == [True, False, False], "what did not run has no section"


def test_recordings_as_expected_have_a_picture(batch: Path) -> None:
    nodes = []
    for number, (kind, name) in enumerate((("score", "cam3_best_worst"), ("sdf-bake", "slices"))):
        folder = batch / f"other{number}/job"
        folder.mkdir(parents=True)
        cv2.imwrite(str(folder / f"{name}.png"), np.zeros((40, 900, 3), np.uint8))
        run = {"command": kind, "splatctrl": "0.2.0", "parts": part_digests(folder)}
        (folder / "run.json").write_text(json.dumps(run))
        done = {"state": "done", "outcome": "passed", "label": "passed", "command": kind}
        nodes.append({"id": f"other{number}/job", "out": f"other{number}/job", **done})
    _, _, pictures = added(batch, *nodes).partition("Pictures of other recordings")
    assert re.findall(r"<figcaption>([^:]+):", pictures) == ["other0/job", "other1/job"]


def test_a_report_against_what_cannot_be_compared_is_refused(run: Runs, batch: Path, tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text("a = 1")
    audit = run(out="audit_2")
    for before in (batch, tmp_path / "other.toml", tmp_path / "missing.toml"):
        expect_refusal(r"expected a|cannot be read", write_report, WriteReportRequest(path=audit, against=before))


def test_a_page_without_webgl_says_so(run: Runs) -> None:
    folder = run()
    reported(folder)
    script = "await wait(1500); found.words = document.querySelector('.space').textContent;"
    found = found_on(folder.with_name("page.html"), script, "--disable-3d-apis")
    assert found["words"].startswith("This browser cannot show it in 3-D")


def test_scene_splats_and_field_have_pages(run: Runs, tmp_path: Path) -> None:
    run()
    scene = view(ViewRequest(path=tmp_path / "scene", out=tmp_path / "scene.html"))
    assert (scene.metrics["num_splats"], scene.metrics["num_states"]) == (2, 0)
    splats = view(ViewRequest(path=tmp_path / "scene" / "splats.ply", out=tmp_path / "ply.html"))
    assert splats.metrics | {"bytes": 0} == scene.metrics | {"bytes": 0, "num_unknown": 0}
    assert (
        main(["sdf-bake", "scene", "-o", "field", "--box=-1.2,-0.2,1.1,-0.8,0.2,1.5", "-q", "--formats", "npz"]) == 0
    )
    assert space_of(tmp_path / "field").surface is not None
    found = found_on(scene.out, f"{OPENED} found.parts = Object.keys(viewer.parts);")
    assert found == {"parts": ["objects", "grid of 10 cm"], "complaints": []}


def test_a_page_is_opened_only_where_there_is_a_screen(
    run: Runs, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, opened = run(), []
    monkeypatch.setattr(command.webbrowser, "open", lambda place: opened.append(place) is None)
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(["view", str(folder), "-o", "a.html"]) == 0
    assert main(["view", str(folder), "-o", "b.html", "--no-open"]) == 0
    for name in command.SCREENS:
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(folder), "-o", "c.html"]) == 0
    assert [place.rpartition("/")[2] for place in opened] == ["a.html"]
    assert "no browser here: open" in capsys.readouterr().err


def test_the_command_line_of_a_program_around_it_is_replaced_by_the_batchs(run: Runs) -> None:
    folder = run()
    words = tuple(open_run(folder).arguments)
    patch_json(folder / "run.json", lambda found: found | {"arguments": ["batch", "suite.toml"]})
    assert replace(open_run(folder), words=words).option("--scene") == "scene"
    assert open_run(folder).option("--scene") is None


def test_a_report_has_the_separation_with_its_inputs_and_without_a_claim(run: Runs, tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text("[robot]\ndeceleration = 2\n[distance]\nintrusion = 0\n")
    page = reported(run("audit", "audit", "--separation", str(cell)))
    words = ("5.5.4.2.3", "No compliance", "Power and force limiting is not assessed", "time below S_p")
    assert all(word in page for word in words)
    inputs = page[page.index("Inputs of the separation") :]
    assert inputs.index("assumed</td>") < inputs.index("declared</td>") < inputs.index("measured</td>")


def test_the_moment_shown_is_of_the_clearance_that_the_verdict_judges() -> None:
    measures = {"barrier": np.array([0.03, 0.04]), "exact": np.array([0.06, 0.05])}
    states = States(
        stamps_ns=np.arange(2), seconds=np.arange(2.0), joints={}, clearance=measures, rungs=(), obstacles=()
    )
    assert states.worst() == 1
    np.testing.assert_array_equal(states.judged, measures["exact"])
    assert replace(states, clearance={"barrier": measures["barrier"]}).worst() == 0
    assert replace(states, clearance={}).worst() is None


def test_space_without_evidence_is_drawn_by_its_reason() -> None:
    last_seen = np.ones((12, 12, 12), np.uint16)
    last_seen[2:5, 2:5, 2:5], last_seen[7:9, 7:9, 7:9] = Unseen.HIDDEN_BY_ARM, Unseen.NO_RETURN
    last_seen[0] = Unseen.SWEPT
    seen = SeenVoxels(origin=np.ones(3), voxel=0.1, last_seen=last_seen, step_stamps_ns=np.array([7]))
    scene = SimpleNamespace(
        is_anisotropic=False, made_from={}, splats=lambda: plain_splats([[1.0, 1.0, 1.0]], [0.01]), seen=lambda: seen
    )
    unknown = space_of_scene(scene).unknown  # type: ignore[arg-type]
    assert {name: len(points) for name, (points, _) in unknown.items() if len(points)} == {
        "hidden by the arm": 26,
        "no return": 8,
    }
    np.testing.assert_allclose(unknown["no return"][0].min(axis=0), 1.7, atol=1e-6)
    header = json.loads(pack(space_of_scene(scene)))["header"]  # type: ignore[arg-type]
    shades = {each["name"]: each["shade"] for each in header["unknown"]}
    assert shades == {"hidden by the arm": 0, "no return": 3}  # a reason has its colour on every page
