"""How a flip is searched for, and sweeps over a simulated recording that goes through the real commands."""

import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.cli.main import main
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.runs.run_folder import open_run
from splatctrl_cli.jobs.sweep.keys import chain_of, key_of
from splatctrl_cli.jobs.sweep.search import find_flip, find_least
from splatctrl_cli.jobs.sweep.sweep import Runs, SweepRequest, sweep
from tests.refused import expect_refusal

PROGRAM = OfThisProgram(threads=1)
TOLERATED = 0.001  # [m] below the margin, which the criterion allows
SIMULATE = ("--duration", "1.0", "--width", "128", "--height", "96", "--noise", "none", "-o", "recording")


@dataclass(frozen=True)
class Recorded:
    """A folder with a simulated recording, its scene, and its audit, made by commands of relative paths."""

    folder: Path

    def command(self, *words: str) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(self.folder)
            patch.setattr(sys, "argv", ["splatctrl", *words, "-q"])
            patch.setattr(fixed, "NEAR_MOVED", 0.01)  # as in the processes of a sweep
            assert main(sys.argv[1:]) == 0

    def words(self, *over: str, run: str = "audit") -> dict[str, list[str]]:
        """The command lines by command that a sweep would run at the values of ``KEY=VALUE``."""
        values = {name: float(text) for name, _, text in (each.partition("=") for each in over)}
        found = open_run(self.folder / run)
        chain = chain_of(found, {name: key_of(name) for name in values}, PROGRAM)
        runs = Runs(run=found, chain=chain, out=self.folder / "out", command_line=PROGRAM)
        return {node.job.command: list(node.words) for node in runs.nodes_at(values)}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    recorded = Recorded(tmp_path_factory.mktemp("recorded"))
    robot = ("--urdf", "recording/robot.urdf", "--spheres", "recording/robot_spheres.yaml")
    fit = ("--cameras", "cam0,cam1,cam2", "--max-splats", "4000", "--set", "scene.fill=0.8")
    quick = ("--set", "scene.first_iterations=40", "--set", "scene.iterations_per_step=5")
    recorded.command("simulate", *SIMULATE)
    recorded.command("reconstruct", "recording/log.mcap", *robot, *fit, *quick, "-o", "scene")
    truth = ("--truth", "recording/truth.json", "--worst-frames", "0")
    recorded.command("replay", "recording/log.mcap", "--scene", "scene", *robot, *truth, "-o", "audit")
    return recorded


def test_the_margin_flips_at_the_clearance_of_the_run(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = open_run(recorded.folder / "audit")
    clearance = min(float(run.metrics[name]) for name in ("min_clearance", "min_clearance_true"))
    request = SweepRequest(
        replay=run.path, over=("margin=0.02:0.06",), out=tmp_path / "sweep", tolerance=1 / 4, workers=2
    )
    flip = sweep(request, PROGRAM).flips[0]
    assert flip.last.values["margin"] <= clearance + TOLERATED < flip.first.values["margin"]
    assert flip.first.values["margin"] - flip.last.values["margin"] <= 0.04 / 4 * (1 + 1e-9)
    assert (flip.last.label, flip.first.label) == ("safe", "margin broken")
    again = open_run(tmp_path / "sweep" / flip.start.folder)  # 0.02 is what the run had: the same comes out again
    assert (again.metrics, again.verdict["reasons"]) == (run.metrics, run.verdict["reasons"])
    assert (again.path / "steps.csv").read_bytes() == (run.path / "steps.csv").read_bytes()
    words = ["sweep", str(run.path), "--over", "margin=0.02:0.06", "--tolerance", "0.25", "-o", str(request.out)]
    assert main([*words, "-v"]) == 0
    said = capsys.readouterr().out
    assert flip.sentence in said and "5 runs, 0 of them new" in said
    assert main([*words, "--over", "margin=0.1:0.1"]) == 2


def test_a_key_of_the_replay_leaves_the_scene_as_it_is(recorded: Recorded) -> None:
    words = recorded.words("latency=0.25")
    assert list(words) == ["replay"]
    assert {"--latency=0.25", f"--scene={recorded.folder / 'scene'}", "--worst-frames=0"} <= set(words["replay"])


def out_of(words: list[str]) -> str:
    return next(word for word in words if word.startswith("--out=")).removeprefix("--out=")


def test_a_key_of_the_map_makes_it_again_with_its_own_options(recorded: Recorded) -> None:
    words = recorded.words("splats=700", "scene.max_gap=0.02", "depth-noise=0.004")
    kept = {"--max-splats=700", "--set=scene.fill=0.8", "--set=scene.max_gap=0.02", "--cameras=cam0,cam1,cam2"}
    assert {*kept, "--perturb=depth-noise=0.004"} <= set(words["reconstruct"])
    assert {f"--scene={out_of(words['reconstruct'])}", "--perturb=depth-noise=0.004"} <= set(words["replay"])
    assert "--cameras=cam0" in recorded.words("cameras-out=2")["reconstruct"]


def test_an_obstacle_is_simulated_again_and_all_read_that(recorded: Recorded) -> None:
    words = recorded.words("obstacle-radius=0.1", "obstacle-x=0.5")
    assert {"--visitor=0.5,0.08,0.1", "--duration=1.0", "--noise=none"} <= set(words["simulate"])
    out = out_of(words["simulate"])
    assert words["reconstruct"][-1] == words["replay"][-1] == f"{out}/log.mcap"
    assert f"--truth={out}/truth.json" in words["replay"]


def test_a_margin_can_turn_a_driven_arm_more_than_once_and_is_searched(recorded: Recorded) -> None:
    run = open_run(recorded.folder / "audit")
    for mode, is_monotone in (("audit", True), ("closed-loop", False)):
        driven = replace(run, words=(*run.arguments, "--mode", mode))
        assert chain_of(driven, {"margin": key_of("margin")}, PROGRAM).keys["margin"].is_monotone == is_monotone


def test_the_options_of_a_run_are_taken_over_as_they_were_given(recorded: Recorded) -> None:
    for name in ("audit", "scene"):
        given = open_run(recorded.folder / name).arguments
        options = PROGRAM.options_of(given)
        assert PROGRAM.options_of(PROGRAM.parsed(given[0], options, Path())[0]) == options


def test_a_key_without_a_map_to_change_is_refused(recorded: Recorded) -> None:
    run = json.loads((recorded.folder / "audit" / "run.json").read_text())
    lockstep = recorded.folder / "lockstep"
    lockstep.mkdir()
    words = [word for word in run["arguments"] if word not in ("--scene", "scene")] + ["--lockstep"]
    del run["inputs"]["splats.ply"]
    (lockstep / "run.json").write_text(json.dumps(run | {"arguments": words}))
    assert "--set=scene.max_splats=700" in recorded.words("splats=700", run="lockstep")["replay"]
    words = "does not say which cameras trained"
    expect_refusal(words, recorded.words, "cameras-out=1", run="lockstep", error=UsageError)


Span = tuple[float, float]


class Counted:
    """Outcomes of values: failed within spans, not evaluable within others; every value may be asked for once."""

    def __init__(self, *failed: Span, lacking: Sequence[Span] = ()) -> None:
        self.failed, self.lacking, self.asked = failed, lacking, list[float]()

    def __call__(self, values: Sequence[float]) -> list[str]:
        assert not set(values) & set(self.asked)
        self.asked += values
        return [self.outcome(value) for value in values]

    def outcome(self, value: float) -> str:
        if any(low <= value < high for low, high in self.failed):
            return "failed"
        return "not evaluable" if any(low <= value < high for low, high in self.lacking) else "passed"


def bisected(judge: Callable[[float], str], low: float, high: float, tolerance: float) -> float:
    """What bisection alone takes for the flip."""
    first = judge(low)
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (middle, high) if judge(middle) == first else (low, middle)
    return high


@pytest.mark.parametrize(("start", "end"), [(0.0, 1.0), (1.0, 0.0), (-3.0, 5.0)])
@pytest.mark.parametrize("is_monotone", [True, False])
def test_a_flip_is_told_to_the_tolerance_from_either_side(start: float, end: float, is_monotone: bool) -> None:
    judge = Counted((0.4371, 9.0))
    found = find_flip(judge, start, end, tolerance=0.001, is_monotone=is_monotone)
    assert found.is_monotone and sorted(found.tried) == sorted(judge.asked)
    assert min(found.last, found.first) < 0.4371 <= max(found.last, found.first)
    assert 0 < abs(found.first - found.last) <= 0.001 * (1 + 1e-9)
    assert judge.outcome(found.last) == judge.outcome(start) != judge.outcome(found.first)


def test_whole_values_flip_between_neighbours() -> None:
    judge = Counted((-1, 1737))
    found = find_flip(judge, 5000, 100, tolerance=200.0, is_whole=True)
    assert (found.last, found.first) == (1737, 1736)
    assert all(value == int(value) for value in judge.asked)
    few = find_flip(Counted((2, 9)), 0, 2, tolerance=0.1, is_whole=True)
    assert (few.last, few.first, len(few.tried)) == (1, 2, 3)


def test_a_verdict_that_turns_back_fools_bisection_and_is_caught() -> None:
    """Between 0.2 and 0.3 it fails, from 0.8 on again: halving sees 0.5 pass and tells the flip at 0.8."""
    judge = Counted((0.2, 0.3), (0.8, 9.0))
    assert bisected(judge.outcome, 0.0, 1.0, 0.001) == pytest.approx(0.8, abs=0.001)
    found = find_flip(judge, 0.0, 1.0, tolerance=0.001, is_monotone=True)
    assert (found.first, found.is_monotone) == (pytest.approx(0.2, abs=0.001), False)
    assert find_flip(Counted((0.2, 0.3), (0.8, 9.0)), 0.0, 1.0, tolerance=0.001, is_monotone=True) == found


@pytest.mark.parametrize(
    ("judge", "first", "outcome", "is_monotone"),
    [
        (Counted((0.1, 0.2), (0.45, 0.55)), pytest.approx(0.1, abs=0.001), "failed", False),
        (Counted((0.3, 0.6)), pytest.approx(0.3, abs=0.001), "failed", False),
        (Counted((0.8, 9.0), lacking=[(0.45, 0.8)]), pytest.approx(0.45, abs=0.001), "not evaluable", True),
        (Counted((5.0, 6.0)), None, "", True),
    ],
    ids=["turns back", "ends that agree", "a third verdict", "none"],
)
def test_the_first_flip_from_the_start_is_found(judge: Counted, first: Any, outcome: str, is_monotone: bool) -> None:
    """If only the middle of the quarters fails, the search turns to the eighths, of which the first fails."""
    found = find_flip(judge, 0.0, 1.0, tolerance=0.001, is_monotone=True)
    assert (found.first, found.is_monotone) == (first, is_monotone)
    assert (judge.outcome(found.first) if found.first is not None else "") == outcome
    assert found.first is not None or (found.last is None and set(map(judge.outcome, found.tried)) == {"passed"})


def test_what_is_not_declared_monotone_is_searched_and_what_may_be_missed_is_told() -> None:
    narrow = (0.51, 0.55)
    declared = find_flip(Counted(narrow), 0.0, 1.0, tolerance=0.01, is_monotone=True)
    searched = find_flip(Counted((0.51, 0.64)), 0.0, 1.0, tolerance=0.01)
    found = [(each.first, each.spacing) for each in (declared, searched)]
    assert found == [(None, pytest.approx(0.25)), (pytest.approx(0.51, abs=0.01), pytest.approx(1 / 8))]
    assert find_flip(Counted(narrow), 0.0, 1.0, tolerance=0.01).spacing > narrow[1] - narrow[0]


def beyond(*slope: float) -> Callable[[Sequence[Sequence[float]]], list[str]]:
    """Fails where the scalar product with the slope is 1 or more."""
    return lambda points: ["failed" if np.dot(slope, point) >= 1.0 else "passed" for point in points]


@pytest.mark.parametrize("slope", [(2.0, 1.5), (1.2, 3.0), (2.0, 2.0, 2.0), (0.9, 0.2)])
def test_the_least_change_of_several_is_near_that_of_a_plane(slope: tuple[float, ...]) -> None:
    alone = [1.0 / each if each >= 1.0 else None for each in slope]
    found = find_least(beyond(*slope), alone, tolerance=0.005)
    assert found.length <= 1.06 * np.linalg.norm(np.array(slope) / np.dot(slope, slope)) + 0.005
    assert found.length == pytest.approx(math.hypot(*found.first), rel=1e-4)
    assert beyond(*slope)([found.last, found.first]) == ["passed", "failed"]
    assert all(0.0 <= share <= 1.0 for share in found.first)
    assert found == find_least(beyond(*slope), alone, tolerance=0.005)


def test_what_only_all_together_flip_is_found_at_the_corner() -> None:
    assert min(find_least(beyond(0.51, 0.51), [None, None], tolerance=0.01).first) > 0.9
    assert find_least(beyond(0.4, 0.4), [None, None], tolerance=0.01) is None


def test_a_flip_of_one_value_alone_stands_where_nothing_is_nearer() -> None:
    assert find_least(beyond(4.0, 0.0), [0.25, None], tolerance=0.01).first == (0.25, 0.0)
