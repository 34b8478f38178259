"""``splatctrl replay --evidence``: how far held-out depth says that the map misses surface, and what that turns."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import load_config
from splatctrl_cli.config.fixed import SPHERE_CELL
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.conformal import conformal_bound
from splatctrl_cli.geometry import look_at
from splatctrl_cli.jobs.replay import evidence
from splatctrl_cli.jobs.replay.evidence import apart_from_robot, open_evidence, select_held_out, select_trained
from splatctrl_cli.jobs.replay.lockstep import reconstruct_scene
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.running.progress import SILENT
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, Intrinsics, Record, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.time_steps import time_steps
from tests.cli.replay_desk import BALL, SECOND, START, Desk, FakeSource, clearance, logged, splats_of, write_scene
from tests.plain import plain_frame

SIZE = (8, 6)
LENS = Intrinsics(fx=2000.0, fy=2000.0, cx=3.5, cy=2.5, width=8, height=6)  # all pixels hit the same millimetres
FROM = np.array([*BALL[0][:2], BALL[0][2] + 1.0])  # above the ball
FAR = ["--set", "verdict.evidence_reach=3"]
MISSES = np.array([2, 9, 4, 7, 3, 8, 1, 6, 5, 8, 2]) * 1e-3  # [m], no two neighbours alike


@dataclass(kw_only=True)
class FilmedSource(FakeSource):
    """Joint states, and the frames of cameras cam0 (no frame) and cam9."""

    frames: list[RgbdFrame] = field(default_factory=list)
    cameras: tuple[str, ...] = ("cam0", "cam9")

    def records(self) -> Any:
        shown = [frame for frame in self.frames if frame.camera in self.cameras]
        both: list[Record] = sorted([*self.states, *shown], key=lambda record: record.stamp_ns)
        yield from both


def test_what_is_within_reach_of_a_sphere_anywhere_in_its_cell_is_near() -> None:
    swept = evidence.Swept(np.zeros((1, 3)), np.array([0.05]), reach=0.1)
    corners = SPHERE_CELL * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 1]])
    reached = corners + 0.149 * np.array([[-1.0, 0, 0], [1, 0, 0], [3**-0.5] * 3])
    assert len(swept.near(reached)) == 3 and len(swept.near(np.array([[0.22, 0.0, 0.0]]))) == 0


def view(stamp_ns: int, depth: float | Float64, eye: Float64 = FROM, camera: str = "cam9") -> RgbdFrame:
    """A narrow view straight down; by micrometres of noise no two are the same."""
    T_world_camera = look_at(eye, eye - [0.0, 0.0, 1.0], up=(0.0, 1.0, 0.0))
    seen = plain_frame(depth, LENS, T_world_camera, stamp_ns=stamp_ns, camera=camera)
    seen.depth[0, 0] *= np.float32(1.0 + 1e-6 * (stamp_ns * 20 // SECOND % 97))
    return seen


def showing(misses: Float64) -> list[RgbdFrame]:
    """A view in each tenth of a second of a surface so far [m] above the ball's."""
    return [view(k * SECOND // 10, 1.0 - BALL[1] - miss) for k, miss in enumerate(misses)]


@pytest.fixture
def scene(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The ball, mapped by cam0, and a log that has a second camera."""
    desk.source = FilmedSource(states=logged(), frames=showing(MISSES))

    def opened(path: Path, options: SourceOptions, joints: object) -> FakeSource:
        names = desk.source.cameras if options.cameras is None else options.cameras
        if unknown := set(names) - set(desk.source.cameras):
            raise InputError(f"{path}: no camera {unknown.pop()!r}", remedy="use one of: cam0, cam9")
        return replace(desk.source, cameras=names)

    monkeypatch.setattr(evidence, "open_states", opened)
    folder = write_scene(desk.folder / "scene", (0, splats_of(BALL)), (SECOND, splats_of(BALL)))
    return ["--scene", str(folder), *FAR, "-q"]


def judged(desk: Desk, scene: list[str], frames: list[RgbdFrame], code: int = 0, *options: str) -> Any:
    """The metrics of an audit that ends with this code, where cam9 recorded these frames."""
    desk.source = FilmedSource(states=logged(), frames=frames)
    assert desk.replay(*scene, "--evidence", "cam9", "--force", *options, is_judged=True) == code
    return desk.metrics()


def view_down(depth: float | Float64, **given: Any) -> list[RgbdFrame]:
    """The same depth in each tenth of a second."""
    return [view(k * SECOND // 10, depth, **given) for k in range(11)]


def reason(desk: Desk, criterion: str = "map error") -> dict[str, Any]:
    (found,) = [reason for reason in desk.verdict()["reasons"] if reason["criterion"] == criterion]
    return found


def test_the_bound_is_that_of_what_the_map_misses(desk: Desk, scene: list[str]) -> None:
    assert desk.replay(*scene, "--evidence", "cam9", is_judged=True) == 0
    expected, metrics = conformal_bound(MISSES, 0.99), desk.metrics()
    assert metrics["map_error_bound"] == pytest.approx(MISSES.max(), abs=1e-4)
    assert metrics["map_error_blocks"] == expected.num_blocks >= 4
    assert metrics["map_error_confidence"] == pytest.approx(expected.num_blocks / (expected.num_blocks + 1))
    assert reason(desk)["outcome"] == "passed" and reason(desk)["count"] == len(MISSES) * SIZE[0] * SIZE[1]
    assert f"map error at most {1e3 * metrics['map_error_bound']:.1f} mm with" in desk.verdict()["sentence"]


def test_a_lower_confidence_takes_a_lower_score(desk: Desk, scene: list[str]) -> None:
    expected = conformal_bound(MISSES, 0.5)
    metrics = judged(desk, scene, showing(MISSES), 0, "--set", "verdict.confidence=0.5")
    found = metrics["map_error_bound"], metrics["map_error_confidence"]
    assert found == (pytest.approx(expected.bound, abs=1e-4), 0.5) and expected.bound < MISSES.max()


def test_a_bound_larger_than_the_clearance_alone_turns_the_verdict(
    desk: Desk, scene: list[str], arm: RobotModel
) -> None:
    least, misses = clearance(arm, START), MISSES.copy()
    assert desk.replay(*scene, is_judged=True) == 0
    misses[6] = least - 0.005
    judged(desk, scene, showing(misses))
    misses[6] = least + 0.02
    judged(desk, scene, showing(misses), 5)
    (broken,) = [reason for reason in desk.verdict()["reasons"] if reason["outcome"] != "passed"]
    assert (broken["criterion"], broken["time_s"]) == ("map error", pytest.approx(0.6))
    assert broken["place"] == pytest.approx([*BALL[0][:2], BALL[0][2] + BALL[1] + misses[6]], abs=2e-3)
    assert (broken["value"], desk.verdict()["label"]) == (pytest.approx(-0.02, abs=1e-3), "not evaluable")


def test_a_contact_outranks_it(desk: Desk, scene: list[str], arm: RobotModel) -> None:
    splats = splats_of(BALL, (tuple(arm.sphere_centers(START)[-1].tolist()), 0.02))
    touched = write_scene(desk.folder / "touched", (0, splats), (SECOND, splats))
    assert desk.replay("--scene", str(touched), *scene[2:], "--evidence", "cam9", is_judged=True) == 1
    assert (desk.verdict()["label"], reason(desk)["outcome"]) == ("contact", "not evaluable")


def test_without_evidence_the_sentence_says_so(desk: Desk, scene: list[str]) -> None:
    assert desk.replay(*scene, is_judged=True) == 0 and "map error not measured" in desk.verdict()["sentence"]
    assert {desk.metrics()[f"map_error_{name}"] for name in ("bound", "blocks", "confidence")} == {None}


GIVEN = ("--require-evidence", "--evidence", "cam9", "--require")


@pytest.mark.parametrize(
    ("options", "code", "first"),
    [
        (("--require-evidence",), 5, "map error"),
        (("--require", "map_error_bound<=0.1"), 5, "--require map_error_bound<=0.1"),
        ((*GIVEN, "map_error_bound<=0.01"), 0, ""),
        ((*GIVEN, "map_error_bound<=0.005"), 1, "--require map_error_bound<=0.005"),
    ],
)
def test_a_request_can_ask_for_evidence(
    desk: Desk, scene: list[str], options: tuple[str, ...], code: int, first: str
) -> None:
    assert desk.replay(*scene, *options, is_judged=True) == code
    assert code == 0 or desk.verdict()["reasons"][0]["criterion"] == first


def test_too_few_blocks_are_no_bound(desk: Desk, scene: list[str]) -> None:
    assert judged(desk, scene, showing(MISSES)[:1], 5)["map_error_bound"] is None
    assert "1 of 1 held-out frame sets show surface" in reason(desk)["sentence"]
    assert "map error not measured" in desk.verdict()["notes"]


def test_only_surface_near_the_motion_and_in_the_judged_time_counts(desk: Desk, scene: list[str]) -> None:
    elsewhere = FROM + np.array([4.0, 4.0, 0.0])
    frames = [*showing(MISSES), view(2 * SECOND, 0.5), view(-SECOND, 0.5)]
    frames += [view(frame.stamp_ns, 1.0, eye=elsewhere, camera="cam8") for frame in frames]
    desk.source = FilmedSource(states=logged(), frames=frames, cameras=("cam0", "cam8", "cam9"))
    assert desk.replay(*scene, "--evidence", "cam9", is_judged=True) == 0
    assert reason(desk)["count"] == len(MISSES) * SIZE[0] * SIZE[1]
    assert desk.replay(*scene, "--evidence", "cam8", out="far", is_judged=True) == 5
    assert "0 of 11 held-out frame sets show" in desk.verdict("far")["sentence"]


def test_what_shows_the_robot_is_no_surface_that_the_map_misses(
    desk: Desk, scene: list[str], arm: RobotModel
) -> None:
    center, radius = highest(arm)
    on, beside = (view_down(1.0 - radius - gap, eye=center + np.array([0.0, 0.0, 1.0])) for gap in (0.02, 0.05))
    judged(desk, scene, on, 5)
    assert "0 of 11 held-out frame sets" in desk.verdict()["sentence"]
    assert judged(desk, scene, beside, 5)["map_error_bound"] > 0.2


def highest(arm: RobotModel) -> tuple[Float64, float]:
    """Centre and radius [m] of the sphere that reaches highest."""
    centers, radii = arm.sphere_centers(START), arm.sphere_set.radii
    top = int(np.argmax(centers[:, 2] + radii))
    return centers[top], float(radii[top])


def test_pixels_at_an_edge_of_depth_are_left_out(desk: Desk, scene: list[str]) -> None:
    depth = np.full(SIZE[::-1], 1.0 - BALL[1] - 0.004)
    depth[:, 3] = 0.7  # flies between two surfaces, 25 cm before the ball
    assert judged(desk, scene, view_down(depth))["map_error_bound"] == pytest.approx(0.004, abs=1e-4)
    assert reason(desk)["count"] == 11 * SIZE[1] * (SIZE[0] - 3)


def test_the_largest_miss_of_a_view_counts_and_a_map_that_is_too_fat_misses_nothing(
    desk: Desk, scene: list[str]
) -> None:
    depth = np.full(SIZE[::-1], 1.0 - BALL[1] + 0.002)  # within the ball
    assert judged(desk, scene, view_down(depth))["map_error_bound"] == 0.0
    depth[4, 5] = 1.0 - BALL[1] - 0.013
    assert judged(desk, scene, view_down(depth))["map_error_bound"] == pytest.approx(0.013, abs=1e-4)


def test_what_spheres_leave_of_the_robot_uncovered_is_the_robot_as_well(
    arm: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    center, radius = highest(arm)
    points = center + np.array([[0, 0, radius + gap] for gap in (0.0, 0.02, 0.04, 0.14)])
    assert len(apart_from_robot(arm, START, points)) == 2
    monkeypatch.setattr(arm, "sphere_deficit", np.full(len(arm.sphere_set.radii), 0.1))
    np.testing.assert_array_equal(apart_from_robot(arm, START, points), points[3:])


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["--evidence", "cam7"], 4, "no camera 'cam7'; use one of: cam0, cam9"),
        (["--evidence", "4"], 2, "was made from every frame set of cam0"),
        (["--evidence", "blind"], 4, "camera blind has no pixel with depth"),
        (["--evidence", "empty"], 4, "camera empty has no pixel with depth"),
    ],
)
def test_evidence_that_is_none_is_refused(
    desk: Desk, scene: list[str], options: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [*showing(MISSES), *view_down(0.0, camera="blind")]
    cameras = ("cam0", "cam9") if said.startswith("no camera") else ("cam0", "cam9", "blind", "empty")
    desk.source = FilmedSource(states=logged(), frames=frames, cameras=cameras)
    assert desk.replay(*scene, *options) == code
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1
    assert not (desk.folder / "out").exists()


SETTINGS = ["scene.max_splats=400", "scene.first_iterations=5", "scene.iterations_per_step=1"]


def request(recording: Path, out: Path, **given: Any) -> ReplayRequest:
    return ReplayRequest(
        log=recording / "log.mcap",
        urdf=recording / "robot.urdf",
        out=out,
        options=SourceOptions(cameras=("cam0", "cam1")),
        config=load_config(None, SETTINGS),
        lockstep=True,
        threads=1,
        **given,
    )


def test_frame_sets_that_are_evidence_are_not_fed_to_the_fitter(
    recording: Path, tmp_path: Path, arm: RobotModel
) -> None:
    asked = request(recording, tmp_path, evidence="3")
    shown = [step.stamp_ns for step in open_evidence(asked, arm).frame_sets()]
    scene = reconstruct_scene(asked, arm, tmp_path, SILENT)
    scene.at(2**62)
    numbers = [{round((ns - scene.stamps_ns[0]) / 1e9 * 5) for ns in stamps} for stamps in (scene.stamps_ns, shown)]
    assert numbers == [{0, 1, 3, 4}, {2, 5}]
    scene.finish()
    run = json.loads((tmp_path / "scene" / "run.json").read_text())
    assert (run["metrics"]["held_out_every"], run["metrics"]["time_steps"]) == (3, 4)


def test_every_set_either_trains_or_is_evidence(recording: Path) -> None:
    source = evidence.open_states(recording / "log.mcap", SourceOptions(), ())
    steps = list(time_steps(source.records(), source.cameras, has_clock=True))
    for every in (2, 3, 5):
        kept, left = select_trained(steps, every), select_held_out(steps, every)
        assert [s.stamp_ns for s in left] == [s.stamp_ns for s in steps[every - 1 :: every]]
        assert [s.stamp_ns for s in kept] == [s.stamp_ns for k, s in enumerate(steps, 1) if k % every]


@pytest.mark.parametrize("evidence", ["2", "cam3"])
def test_a_lockstep_bounds_its_own_map(recording: Path, tmp_path: Path, evidence: str) -> None:
    robot = ["--urdf", str(recording / "robot.urdf"), "--spheres", str(recording / "robot_spheres.yaml")]
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    log = ["replay", str(recording / "log.mcap"), *robot, "--threads", "1", "-q", "--report-only", *settings]
    out, again = tmp_path / "out", tmp_path / "again"
    assert main([*log, "--lockstep", "--evidence", evidence, "-o", str(out)]) in (0, 3)
    assert ("cam3" in json.loads((out / "scene" / "run.json").read_text())["metrics"]["cameras"]) == (evidence == "2")
    log += ["--scene", str(out / "scene"), "--evidence"]
    assert main([*log, evidence, "-o", str(again)]) in (0, 3)
    metrics, same = (json.loads((run / "summary.json").read_text())["metrics"] for run in (out, again))
    assert 0 <= metrics["map_error_bound"] < 0.3 and metrics["map_error_blocks"] >= 2
    assert same["map_error_bound"] == metrics["map_error_bound"]
    assert main([*log, "3", "-o", str(tmp_path / "3")]) == 2


def test_the_map_of_evidence_is_the_one_that_states_before_it_were_judged_by(desk: Desk, scene: list[str]) -> None:
    low = ((BALL[0][0], BALL[0][1], BALL[0][2] - 0.03), BALL[1])
    grown = write_scene(
        desk.folder / "grown", (0, splats_of(low)), (SECOND // 2, splats_of(BALL)), (SECOND, splats_of(BALL))
    )
    frames = [view(k * SECOND // 10, 1.0 - BALL[1]) for k in (5, 6, 8, 10)]  # from 0.5 s on, as it is then
    for shown, bound in ((frames, 0.03), (frames[1:], 0.0)):
        desk.source = FilmedSource(states=logged(), frames=shown)
        assert desk.replay("--scene", str(grown), *scene[2:], "--evidence", "cam9", "--force") == 0
        assert desk.metrics()["map_error_bound"] == pytest.approx(bound, abs=1e-4)
