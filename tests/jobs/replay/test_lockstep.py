"""``splatctrl replay --lockstep`` and ``--latency``: what is known of the scene at each time, and since when."""

import csv
import json
import re
import weakref
from collections.abc import Callable, Collection, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.cli.main import main
from splatctrl_cli.config import Config, load_config
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.jobs.reconstruct.reconstruction import Reconstruction
from splatctrl_cli.jobs.replay import known_scene, lockstep
from splatctrl_cli.jobs.replay import replay as job
from splatctrl_cli.jobs.replay.known_scene import KnownFields, read_splat_scene
from splatctrl_cli.jobs.replay.lockstep import check_lockstep, reconstruct_scene
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.report.spaces import scene_of, sets_known
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.runs.run_folder import open_run
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.scene.time_steps import TimeStep
from tests.cli.replay_desk import BALL, SECOND, START, Desk, clearance, splats_of, write_scene
from tests.jobs.bake.baked import Said
from tests.jobs.running.test_device import cards, run_of
from tests.kernels.cuda.emulator import EmulatedDevice
from tests.refused import expect_refusal

SETTINGS = [
    *("scene.max_splats=600", "scene.first_iterations=15", "scene.iterations_per_step=3"),
    "occupancy.voxel=0.04",
]
FAST = ["--threads", "1", "-q", *(word for setting in SETTINGS for word in ("--set", setting))]


class Replayed(NamedTuple):
    """rows: of steps.csv; stamps: of the frames by camera from which the clock was estimated."""

    rows: list[dict[str, str]]
    stamps: dict[str, list[int]]
    out: Path


Replays = Callable[..., Replayed]


@pytest.fixture(scope="module")
def replayed(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Replays:
    """A replay of the recording, in lockstep or (`has_folder`) after `reconstruct`; the same one is made once."""
    folder, estimated = tmp_path_factory.mktemp("replays"), job.clock_of
    robot = ["--urdf", str(small_recording / "robot.urdf"), "--spheres", str(small_recording / "robot_spheres.yaml")]
    log = [str(small_recording / "log.mcap"), *robot, "--cameras", "cam0,cam1", *FAST]

    @cache
    def replay(*options: str, every: int = 1, has_folder: bool = False) -> Replayed:
        stamps = dict[str, list[int]]()

        def watched(model: RobotModel, logged: Any, motion: ImageMotion) -> Any:
            stamps.update({name: list(camera.stamps_ns) for name, camera in motion.cameras.items()})
            return estimated(model, logged, motion)

        out, scene = folder / f"{len(list(folder.iterdir()))}", folder / f"scene_{every}"
        every_set = ["--set", f"scene.snapshot_every={every}"]
        known = ["--lockstep", *every_set]
        if has_folder:
            if not scene.exists():
                assert main(["reconstruct", *log, *every_set, "-o", str(scene)]) == 0
            known = ["--scene", str(scene)]
        words = ["replay", *log, *known, "-o", str(out), "--max-unknown", "1", "--report-only", *options]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(job, "clock_of", watched)
            assert main(words) in (0, 3)
        with (out / "steps.csv").open() as stream:
            return Replayed(list(csv.DictReader(stream)), stamps, out)

    return replay


@pytest.mark.parametrize("every", [1, 3])
def test_a_lockstep_says_what_a_reconstruction_with_snapshots_would(replayed: Replays, every: int) -> None:
    rows = replayed(every=every, has_folder=False).rows
    assert rows == replayed(every=every, has_folder=True).rows
    ages = [float(row["map_age_s"]) for row in rows]
    assert min(ages) >= 0 and max(ages) == pytest.approx(0.2 * every - 0.02, abs=0.021)


DRIVE = ("--mode", "closed-loop", "--latency", "0.3", "--set", "control.max_time=0.2")


def test_a_closed_loop_in_lockstep_drives_as_in_the_reconstruction(replayed: Replays) -> None:
    """Except in unknown_share: known space is what was seen until the arm stopped, there in the whole log."""
    rows, expected = (
        [row | {"unknown_share": ""} for row in replayed(*DRIVE, every=1, has_folder=has_folder).rows]
        for has_folder in (False, True)
    )
    assert rows == expected and all(float(row["map_age_s"]) >= 0.3 - 1e-9 for row in rows)


def test_a_lockstep_measures_how_far_off_the_cameras_see_the_robot(sample_data: Path, tmp_path: Path) -> None:
    tabletop = sample_data / "tabletop"
    robot = RobotModel.from_urdf(tabletop / "robot.urdf", tabletop / "robot_spheres.yaml")
    robot = robot.moved_by([f"panda_joint{number}" for number in range(1, 8)])
    rows = opened(tabletop, tmp_path, robot, latency=0.0).figures()["displaced_cameras"]
    assert rows and max(row["distance_mm"] for row in rows.values()) < 1.0


def test_frame_sets_are_taken_in_only_when_the_clock_has_passed_them(
    small_recording: Path, tmp_path: Path, arm: RobotModel
) -> None:
    scene = opened(small_recording, tmp_path, arm, latency=0.25)
    (first,) = scene.stamps_ns
    assert scene.first_ns == first + SECOND // 4
    expect_refusal("no map is known yet", scene.at, first, error=NotEvaluableError)
    for num, seconds in ((1, 0.44), (2, 0.46), (3, 0.66), (3, 0.5)):
        scene.at(first + round(seconds * SECOND))
        assert len(scene.stamps_ns) == num
    assert scene.age_s(first + SECOND // 2) == pytest.approx(0.3, abs=1e-6)
    assert scene.step_at(first + round(0.66 * SECOND)).seconds == pytest.approx(0.2, abs=1e-3)
    scene.finish()
    assert {"splats.ply", "run.json", "snapshots.csv", "occupancy.npz"} <= {
        path.name for path in (tmp_path / "scene").iterdir()
    }


def test_a_replay_in_real_time_names_what_it_dropped(replayed: Replays) -> None:
    summary = replayed("--real-time", every=1).out / "summary.json"
    notes = "; ".join(json.loads(summary.read_text(encoding="utf-8"))["verdict"]["notes"])
    assert re.search(r"in real time \d of 5 frame sets were dropped; maps were 0\.\d\d s late in the median", notes)
    run = open_run(summary.parent)
    states, metrics = run.states, run_of(summary.parent / "scene")["metrics"]
    since = [time for time, _ in sets_known(run, states, scene_of(run))]
    stamps = [snapshot.stamp_ns for snapshot in scene_of(run).snapshots]
    known = [stamp + round(1e9 * delay) for stamp, delay in zip(stamps, metrics["map_delays_s"], strict=True)]
    used = [max(0.0, 1e-9 * (each - states.stamps_ns[0])) for each in known if each <= states.stamps_ns[-1]]
    assert since == used[-len(since) :]
    expect_refusal(
        "--real-time: expected --lockstep",
        check_lockstep,
        ReplayRequest(log=Path(), scene=Path(), real_time=True),
        error=UsageError,
    )


def test_the_log_is_read_four_times(
    replayed: Replays, small_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For its survey, the checks that can stop it, in lockstep with the clock, and for the truth and worst frames."""
    passes: list[object] = []
    messages = McapLog.messages

    def counted(log: McapLog, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        yield from messages(log, damage, names)
        passes.append(names)

    monkeypatch.setattr(McapLog, "messages", counted)
    assert replayed("--truth", str(small_recording / "truth.json")).rows
    assert len(passes) == 4 and passes[0] is None


def test_the_clock_is_estimated_from_every_frame_also_where_the_arm_stops_before(replayed: Replays) -> None:
    of_each = [replayed(*drive, every=1, has_folder=known).stamps for drive in ((), DRIVE) for known in (False, True)]
    assert all(stamps == of_each[0] for stamps in of_each)
    assert {len(stamps) for stamps in of_each[0].values()} == {5}


def test_the_fit_of_a_lockstep_computes_where_it_is_told_to(
    small_recording: Path, tmp_path: Path, arm: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    cards(monkeypatch, memory := EmulatedDevice())
    opened(small_recording, tmp_path, arm, latency=0.0, device="cuda").finish()
    assert [each["device"] for each in run_of(tmp_path / "scene")["metrics"]["devices"]] == ["cuda:0"]
    assert not memory.sizes  # given back
    expect_refusal(
        "--device cuda: expected --lockstep",
        check_lockstep,
        ReplayRequest(log=small_recording, out=tmp_path, scene=tmp_path, device="cuda"),
        error=UsageError,
    )


@pytest.mark.parametrize(
    ("seconds", "used", "delays"),
    [
        (0.05, [0, 1, 2, 3, 4], [0.0, 0.05, 0.05, 0.05, 0.05]),
        (0.25, [0, 1, 2, 3, 4], [0.0, 0.25, 0.3, 0.35, 0.4]),
        (0.5, [0, 1, 3, 4], [0.0, 0.5, 0.6, 0.9]),
        (0.7, [0, 1, 4], [0.0, 0.7, 0.8]),
    ],
)
def test_in_real_time_a_map_is_known_when_it_is_computed_and_the_newest_frame_set_waits(
    small_recording: Path,
    tmp_path: Path,
    arm: RobotModel,
    monkeypatch: pytest.MonkeyPatch,
    seconds: float,
    used: list[int],
    delays: list[float],
) -> None:
    """Five frame sets, 0.2 s apart, on a machine that computes each for the same time."""
    now, take = [0.0], Reconstruction.take

    def take_long(fitted: Reconstruction, step: TimeStep, console: Progress) -> Any:
        now[0] += seconds
        return take(fitted, step, console)

    monkeypatch.setattr(lockstep.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(Reconstruction, "take", take_long)
    scene = opened(small_recording, tmp_path, arm, latency=0.0, is_real_time=True)
    first = scene.stamps_ns[0]
    assert scene.first_ns == first  # a live run begins with a map
    starts = [0.0, *(0.2 * number + delay - seconds for number, delay in zip(used[1:], delays[1:], strict=True))]
    for past in np.arange(0.01, 3, 0.1):
        scene.advance(first + round(past * SECOND))
        assert len(scene.stamps_ns) == sum(start <= past for start in starts), "the future is not computed"
    np.testing.assert_allclose(np.subtract(scene.stamps_ns, first) / SECOND, 0.2 * np.array(used), atol=1e-3)
    np.testing.assert_allclose(np.subtract(scene.known_ns, scene.stamps_ns) / SECOND, delays, atol=1e-3)
    assert scene.figures()["num_dropped_sets"] == 5 - len(used)
    for stamp, known in zip(scene.stamps_ns, scene.known_ns, strict=True):
        assert scene.depth_ns(known) == scene.depth_ns(scene.own_ns(stamp)) == stamp
        assert scene.depth_ns(known - 1) != stamp


def test_it_says_how_long_a_frame_set_took(small_recording: Path, tmp_path: Path, arm: RobotModel) -> None:
    said = Said()
    scene = opened(small_recording, tmp_path, arm, latency=0.0, console=said)
    scene.advance(scene.stamps_ns[0] + SECOND)
    scene.finish()
    found = re.search(
        r"lockstep: 5 frame sets, recorded 200 ms apart, took (\d+) ms each in the median, (\d+) ms at",
        said.lines[-1],
    )
    assert 0 < int(found[1]) <= int(found[2])


def opened(
    small_recording: Path,
    folder: Path,
    arm: RobotModel,
    *,
    latency: float,
    is_real_time: bool = False,
    device: str = "auto",
    console: Progress = SILENT,
) -> known_scene.KnownScene:
    request = ReplayRequest(
        log=small_recording / "log.mcap",
        urdf=small_recording / "robot.urdf",
        out=folder,
        options=SourceOptions(cameras=("cam0", "cam1")),
        lockstep=True,
        device=device,
        latency=latency,
        real_time=is_real_time,
        mode="closed-loop",
        threads=1,
        config=load_config(None, SETTINGS),
    )
    return reconstruct_scene(request, arm, folder, console)


def test_a_map_is_known_only_after_the_latency(desk: Desk, arm: RobotModel) -> None:
    small = (BALL[0], 0.02)
    snapshots = ((0, splats_of(small)), (SECOND // 2, splats_of(BALL)))
    assert desk.replay("--scene", str(write_scene(desk.folder / "scene", *snapshots)), "-q", "--latency", "0.2") == 0
    assert desk.metrics()["num_before_scene"] == 2
    clearances = [clearance(arm, START, small)] * 5 + [clearance(arm, START, BALL)] * 4
    expected = np.column_stack([clearances, [0.2, 0.3, 0.4, 0.5, 0.6, 0.2, 0.3, 0.4, 0.5]])
    found = [[float(row["clearance_exact"]), float(row["map_age_s"])] for row in desk.rows()]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_fields_of_three_scenes_are_kept_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, make = list[weakref.ref[KnownFields]](), known_scene.splat_fields

    def counted(*given: Any) -> KnownFields:
        fields = make(*given)
        made.append(weakref.ref(fields))
        return fields

    monkeypatch.setattr(known_scene, "splat_fields", counted)
    scene = read_splat_scene(
        write_scene(tmp_path / "scene", *((k * SECOND, splats_of(BALL)) for k in range(6))), Config(), 1
    )
    for stamp in range(0, 6 * SECOND, SECOND // 4):
        assert scene.at(stamp) is scene.at(stamp)
        scene.step_at(stamp)
        assert sum(ref() is not None for ref in made) <= 3
    assert len(made) == 6
